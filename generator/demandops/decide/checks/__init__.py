"""What refuses a demand although it is well formed."""
