"""Rate against quality: pooled curves, their hull, paired Bjontegaard deltas, rates at one quality, Pareto fronts.

Pure numbers over `Method`, the measured points of one curve; nothing here reads, writes or draws.
"""

from cable_rpc.study.rate_quality.curves import PooledPoint, hull, left_out, pooled_points
from cable_rpc.study.rate_quality.delta import DeltaResult, bd_quality_between, bd_rate_between
from cable_rpc.study.rate_quality.fixed_quality import FixedQuality, SavingAtQuality, rate_at, saving_at
from cable_rpc.study.rate_quality.pareto import ParetoPoint, pareto_front, pareto_points
from cable_rpc.study.rate_quality.points import Method, SequencePoint

__all__ = [
    "DeltaResult",
    "FixedQuality",
    "Method",
    "ParetoPoint",
    "PooledPoint",
    "SavingAtQuality",
    "SequencePoint",
    "bd_quality_between",
    "bd_rate_between",
    "hull",
    "left_out",
    "pareto_front",
    "pareto_points",
    "pooled_points",
    "rate_at",
    "saving_at",
]
