"""Pictures in the project's style, with one function for each picture."""
