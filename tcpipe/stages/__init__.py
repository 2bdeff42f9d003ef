"""Stages: functions from table to table, in this order.

::

    streams    = read_run(log, config.read)              L0 → L1   messages become SI columns, one table a role
    track      = fuse_run(streams, config.fuse)          L1 → L2   all sensors become one pose 20 times a second
    masked     = mask_track(track, config.mask)          L2 → L3   rows that are not steady driving get their reasons
    segments   = segment_track(masked, config.segment)    L3 → L4   the path is cut into chords of 1 m
    labelled   = label_segments(segments, config.label)  L4 → L5   each metre gets power, velocity, time, energy
    sampled    = sample_segments(labelled, map)          L5 → L6   each segment gets its rotated patch of the map

`tcpipe.pipeline.ingest_run.run_stages` calls the first five on a log, `tcpipe.pipeline.dataset.build` the last on a
map. A stage accesses no file.
"""
