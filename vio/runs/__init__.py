"""A recording processed into a folder, and that folder read back."""
