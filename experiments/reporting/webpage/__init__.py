"""The web page of results: its parts, and their assembly into one file."""
