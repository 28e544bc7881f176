"""Many recordings, configurations and seeds: one table.

The implementation of `vio bench`; docs/bench.md says how.
"""
