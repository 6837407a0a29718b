"""Use the operating system: scheduling, child processes, access, clocks, disk, resource limits."""
