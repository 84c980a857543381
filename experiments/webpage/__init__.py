"""Results as one web page that needs nothing else, part by part."""
