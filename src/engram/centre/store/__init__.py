"""What the service keeps beside the maps: its tables, and its objects."""
