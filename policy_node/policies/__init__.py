"""What acts: trained actors of every format, and the files they live in."""
