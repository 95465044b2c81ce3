"""One harness for every agent: the same scenes, one record an episode, counts with intervals.

Imports neither torch nor an agent: agents are named and loaded in child processes.
"""
