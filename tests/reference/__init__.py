"""Reference results of scale=test in fp32: scenes, poses, integer maps and tables.

Written anew, after a change that is meant to change results, by `python -m tests.reference`; the change log says why.
"""
