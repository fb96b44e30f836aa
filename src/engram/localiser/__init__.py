"""Live frame + neighbourhood + policy + budget → localisation; lost and found again."""
