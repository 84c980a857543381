"""Tools for files, for names that users choose, and for dataclasses stored as JSON."""
