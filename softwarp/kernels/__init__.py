"""Warp kernels, one file for each physical concept, written once for single worlds, SIMD lanes and CUDA."""
