"""The EBN loop: localise, else save an experience. Saving runs on its own thread."""
