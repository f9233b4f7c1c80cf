"""Benchmarks behind ``softwarp bench``: scenes and their timing, scaling, peers, cold start, training, robustness."""
