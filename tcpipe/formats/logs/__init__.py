"""Robot logs: ROS 1 and ROS 2 bags, MCAP, tables and autopilot logs, as `tcpipe.formats.logs.log_file` reads them.

The way from a path to a table, each step importing only those below it::

    pipeline.ingest
    log_joining     several files of one drive as one log
    table_log       a folder of CSV, text or Parquet tables as a log; autopilot_log: one of PX4 or ArduPilot
    message_tables  result of both readers, and readers of other packages: topics that are tables in memory
    log_file        a log: its files, topics and tables            arrow_columns   payloads to columns, by ros_types
    table_folders   which files are logs, and which folders of tables
    rosbag2         a bag directory's files; messages that are compressed one by one
    mcap_file, bag_file, sqlite_file    a file: its index, else a walk; what is lost
    mcap_records    bytes
    chunk_reading   which of a chunk's bytes to read, and whether its index is borne out
    log_part        what all give and use: channels, blocks of messages, bytes by position, also of files in object
    storage
"""
