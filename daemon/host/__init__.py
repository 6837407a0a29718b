"""Use the operating system: scheduling, child processes, rights, clocks, disk, resource limits."""
