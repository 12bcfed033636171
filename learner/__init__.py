"""Learns: the loop, the roster of workers, the algorithms. Open train.py first. Never imports workers."""
