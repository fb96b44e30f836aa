"""Pictures of maps, matches and trajectories."""
