"""The second generator of hidden cases, in `benchmarks/mujoco_arms`."""
