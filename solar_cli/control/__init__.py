"""Time-varying linear-Gaussian policies, the KL-constrained LQR, planners."""
