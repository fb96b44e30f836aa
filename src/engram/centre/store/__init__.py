"""What the service stores in addition to the maps: its tables and objects."""
