"""First contact with the hardware of a rig: order, sign and scale of its channels, small forces."""
