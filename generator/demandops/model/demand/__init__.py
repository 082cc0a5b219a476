"""What is demanded: goals of both actions, and what they become."""
