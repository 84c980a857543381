"""What commands may be asked; nothing here loads what they do it with."""
