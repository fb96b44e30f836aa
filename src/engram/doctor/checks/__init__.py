"""What the doctor measures, one subject a file: evidence in, one number out."""
