"""`drt-jax check`: compares results on this machine with other programs and closed forms.

`scenes` computes, `truth` has the reference values, `run` compares and describes the
machine. Command and printing are in `drt_jax.__main__`.
"""
