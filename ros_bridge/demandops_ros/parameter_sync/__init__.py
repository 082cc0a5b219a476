"""Parameter sync: keeps the parameters of a running ROS node as a ConfigMap has them."""
