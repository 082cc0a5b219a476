"""What people can run to see DemandOps work."""
