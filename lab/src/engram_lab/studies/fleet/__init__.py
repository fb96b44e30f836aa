"""[G16]'s experiments: building in parallel, sharing, downloads, orders of merging (method §8)."""
