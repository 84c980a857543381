"""Results of commands: tables, pictures and the web page."""
