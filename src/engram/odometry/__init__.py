"""Frame stream → motion between successive frames, with covariance."""
