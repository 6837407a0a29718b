"""Run the rig: supervisor, control loop, recorder, planner and control socket."""
