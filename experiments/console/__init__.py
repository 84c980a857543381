"""The command line: options and reports that the commands share."""
