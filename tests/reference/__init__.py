"""Reference results of scale=test in fp32: scenes, poses, integer maps and tables.

Computed at commit 041e48c, before the code was restructured. After a change that is meant to change results, write it
with `python -m tests.reference`; the changelog states why.
"""
