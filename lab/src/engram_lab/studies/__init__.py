"""The papers' experiments: cross-validation, sweeps, figures and tables (method §8)."""
