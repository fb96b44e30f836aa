"""The fleet: many robots, one centre (method §7): merging, downloading, building."""
