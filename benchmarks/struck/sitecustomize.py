"""Has every Python that is started by a fault campaign count its requests to a bucket; see `fault_workers`."""

import fault_workers

fault_workers.join_watch()
