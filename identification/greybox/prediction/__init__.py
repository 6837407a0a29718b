"""One-step and multistep predictions by a Kalman filter, and the noise they assume."""
