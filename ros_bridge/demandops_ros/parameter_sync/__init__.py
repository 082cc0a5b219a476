"""Parameter sync: keeps the parameters of a running ROS node equal to those in a ConfigMap."""
