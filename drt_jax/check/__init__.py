"""`drt-jax check`: whether this machine computes what other programs and closed forms say.

`scenes` computes, `truth` has the numbers that must come out, `run` compares and describes the
machine. Command and printing are in `drt_jax.__main__`.
"""
