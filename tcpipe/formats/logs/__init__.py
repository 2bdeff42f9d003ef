"""Robot logs on disk: ROS 1 bags, ROS 2 bags and MCAP, behind one face, `tcpipe.formats.logs.log_file`."""
