"""Robot logs: ROS 1 and ROS 2 bags, MCAP, tables and autopilot logs, as `tcpipe.formats.logs.log_file` reads them.

The modules from a path to a table; each imports only those below it::

    pipeline.ingest
    log_joining     several files of one drive as one log
    table_log       a folder of CSV, text or Parquet tables as a log; autopilot_log: one of PX4 or ArduPilot
    message_tables  result of both readers, and readers of other packages: topics that are tables in memory
    log_file        a log: its files, topics and tables            arrow_columns   payloads to columns, by ros_types
    table_folders   which files are logs, and which folders of tables
    rosbag2         a bag directory's files; messages that are compressed one by one
    mcap_file, bag_file, sqlite_file    a file: messages by its index, else from all records; damage
    mcap_records    records of MCAP
    chunk_reading   selects the bytes of a chunk to read, and compares its index with its records
    log_part        interface of a file: channels, blocks of messages, bytes by position, also in object storage
"""
