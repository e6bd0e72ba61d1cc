"""The benchmark suite: one frame that runs cases and keeps rows, one file per benchmark.

A benchmark is a module-level `Benchmark` that is named in the entry-point group `clothgym.benchmarks`.
"""

from clothgym.benchmarks.frame import Benchmark, Case
from clothgym.benchmarks.report import Page, Table

__all__ = ["Benchmark", "Case", "Page", "Table"]
