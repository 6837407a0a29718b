"""Read logs into records: aligned, resampled, checked for enough excitation."""
