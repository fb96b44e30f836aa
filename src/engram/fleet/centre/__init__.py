"""The fleet's shared map as a service."""
