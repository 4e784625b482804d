"""Solar: model-based reinforcement learning from images, run and compared from the command line."""
