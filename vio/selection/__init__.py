"""Which observations enter the update."""
