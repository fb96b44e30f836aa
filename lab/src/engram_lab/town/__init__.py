"""A town to drive in: rendered drives through changing light, weather and life, with truth."""
