"""What advances many examples of a system through many steps: drones, for the rest of the library.

A system is two functions on pytrees, `lanes.System`: what every step needs of the constants, and a step. The engine
knows no physics. Imports point one way, from what a program contains to where it runs:

- `scalars`: a traced function carried out one number at a time, and whether one consists of numbers alone;
- `cpu_kernel`: a computation that XLA's CPU compiler makes one function of; `groups`: a batch in such groups;
- `lanes`: what many steps mean, forward, and their derivatives; `primitive`: these as operations of jax;
- `batching`: a function of many examples made into one that jax can transform;
- `gpu`, `gpu_kernel`: the same in one kernel on a GPU, and the choice of it.
"""
