"""What `jaxik doctor` looks at. Works where JAX or another package is broken.

What needs JAX runs in a process of its own (`with_jax`), because XLA ends a process that it does
not like, for instance over a flag. Start with `examination`.
"""
