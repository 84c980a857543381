"""Reading and writing of files, names that users choose, and dataclasses stored as JSON."""
