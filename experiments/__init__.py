"""Commands of mmwave-loc, one module each, and the folders of code that they share."""
