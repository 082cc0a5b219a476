"""Stand-ins for the programs in the containers; commands, parameters and topics are the real ones.

The interfaces of perception_msgs are not installed, so ego data are `geometry_msgs/PoseStamped` and
object lists `geometry_msgs/PoseArray`. Point clouds are `sensor_msgs/PointCloud2`.
"""
