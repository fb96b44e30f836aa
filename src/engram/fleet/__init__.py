"""The fleet: many robots, one centre (SPEC §7): merging, downloading, building."""
