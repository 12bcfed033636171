"""Learns: the loop, the coordinator of workers, the algorithms. Open train.py first. Never imports workers."""
