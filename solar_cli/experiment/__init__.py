"""From a list of cells to finished ones: the matrix, the worker, the scheduler and its engines."""
