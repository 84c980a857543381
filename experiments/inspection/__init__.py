"""What a data set is: recognized, read in blocks, summed up."""
