"""Web page of results in one file, part by part."""
