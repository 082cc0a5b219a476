"""Commands that show the state repo or the clusters, and change nothing."""
