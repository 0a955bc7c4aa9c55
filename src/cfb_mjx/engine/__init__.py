"""Advance many examples of a system (drones, in this library) through many steps, on CPU and GPU.

A system is a pair of functions on pytrees, `lanes.System`: one prepares what every step needs of the constants, the
other is a step. The engine contains no physics. The modules import each other in one direction, from the contents of a
program to the device it runs on:

- `scalars`: evaluates a traced function one number at a time, and checks whether it consists of numbers alone;
- `cpu_kernel`: lets XLA's CPU compiler make one function of a computation;
- `lanes`: defines many steps and their derivatives in both modes; `primitive`: makes primitives of JAX of these;
- `batching`: makes a function of many examples a function of one that JAX can transform, and runs large batches in
  groups, each in one such compiled function;
- `gpu`, `gpu_kernel`: a whole rollout in one GPU kernel, and the choice between the kernel and the plain program.
"""
