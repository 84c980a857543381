"""The command line: options and reports that the commands beside this folder share."""
