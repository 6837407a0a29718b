"""Read logs into records: resample, align commands, check the excitation."""
