"""The figures that the paper and its supplement print."""

from __future__ import annotations

from collections.abc import Mapping

_MAIN = ("mpve_mm", "vfcp_percent", "cfmp_percent")
_PRINTED: Mapping[str, tuple[tuple[str, ...], Mapping[str, Mapping[str, tuple[float, ...]]]]] = {
    "comparison": (
        (
            "tailornet",
            "naive-approx",
            "naive-accurate",
            "optimisation-approx",
            "optimisation-accurate",
            "collision-loss-approx",
            "collision-loss-accurate",
            "refu-approx",
            "refu-accurate",
            "refu-hybrid",
        ),
        {
            "shirt-male": {
                "mpve_mm": (11.27, 11.45, 11.26, 11.30, 11.26, 10.85, 10.61, 10.59, 10.56, 10.57),
                "vfcp_percent": (1.18, 0.69, 0.0, 0.41, 0.0, 1.28, 0.68, 0.62, 0.0, 0.51),
                "cfmp_percent": (11.92, 3.1, 27.5, 25.21, 50.36, 20.21, 39.35, 26.9, 63.06, 49.32),
            },
            "tshirt-male": {
                "mpve_mm": (10.77, 10.81, 10.75, 10.76, 10.75, 10.60, 10.59, 10.58, 10.57, 10.56),
                "vfcp_percent": (0.95, 0.56, 0.0, 0.39, 0.0, 0.85, 0.86, 0.53, 0.0, 0.34),
                "cfmp_percent": (23.96, 12.01, 38.02, 36.57, 51.60, 28.98, 28.76, 32.18, 58.77, 47.25),
            },
            "short-pant-male": {
                "mpve_mm": (6.81, 6.87, 6.83, 6.82, 6.81, 6.79, 6.80, 6.79, 6.76, 6.77),
                "vfcp_percent": (0.27, 0.83, 0.07, 0.11, 0.0, 0.19, 0.21, 0.13, 0.0, 0.13),
                "cfmp_percent": (60.35, 20.07, 73.47, 68.60, 81.42, 68.38, 66.78, 73.28, 83.05, 76.89),
            },
            "skirt-female": {
                "mpve_mm": (6.90, 9.35, 6.90, 6.98, 6.90, 6.92, 6.90, 6.90, 6.87, 6.89),
                "vfcp_percent": (0.067, 0.04, 0.0, 0.015, 0.0, 0.059, 0.047, 0.028, 0.0, 0.027),
                "cfmp_percent": (93.36, 78.78, 93.87, 94.01, 96.45, 93.99, 94.44, 96.03, 98.16, 96.43),
            },
            "all": {
                "mpve_mm": (8.89, 9.67, 8.89, 8.92, 8.88, 8.74, 8.67, 8.66, 8.64, 8.65),
                "vfcp_percent": (0.60, 0.50, 0.01, 0.22, 0.0, 0.58, 0.43, 0.31, 0.0, 0.24),
                "cfmp_percent": (49.09, 30.89, 59.39, 57.42, 70.97, 54.36, 59.15, 58.52, 76.77, 68.71),
            },
        },
    ),
    "ablation": (
        ("tailornet", "fixed-approx", "fixed-accurate", "refu-approx", "refu-accurate", "refu-hybrid"),
        {
            "shirt-male": {
                "mpve_mm": (11.27, 10.84, 10.60, 10.59, 10.56, 10.57),
                "vfcp_percent": (1.18, 0.58, 0.0, 0.62, 0.0, 0.51),
                "cfmp_percent": (11.92, 4.88, 37.22, 26.9, 63.06, 49.32),
                "avg_vf": (180.36, 287.85, 1.94, 110.12, 1.45, 78.21),
                "avg_ee": (11.56, 19.60, 8.89, 8.6, 6.98, 7.39),
            }
        },
    ),
    "alpha": (
        ("tailornet", "alt1-approx", "alt2-approx", "refu-approx"),
        {
            "shirt-male": {
                "mpve_mm": (11.27, 10.65, 10.66, 10.59),
                "vfcp_percent": (1.18, 0.76, 0.79, 0.62),
                "cfmp_percent": (11.92, 21.36, 20.81, 26.9),
            }
        },
    ),
    "gcnn": (
        ("gcnn", "gcnn-refu-approx", "gcnn-refu-accurate", "gcnn-refu-hybrid"),
        {
            "": {  # the supplement doesn't say for which garment
                "mpve_mm": (14.05, 13.05, 12.82, 12.93),
                "vfcp_percent": (2.26, 0.81, 0.0, 0.72),
                "cfmp_percent": (8.70, 19.92, 40.98, 36.78),
            }
        },
    ),
    "sequence": (
        ("mlp-5", "mlp-5-refu-approx", "mlp-17", "mlp-17-refu-approx"),
        {
            "": {
                "mpve_mm": (15.36, 13.15, 18.23, 16.12),
                "vfcp_percent": (1.78, 0.56, 3.18, 0.86),
                "cfmp_percent": (18.69, 52.53, 13.30, 38.39),
            }
        },
    ),
    "laplacian": (
        ("optimisation-approx", "optimisation-accurate", "refu-approx", "refu-accurate", "refu-hybrid"),
        {"shirt-male": {"laplacian_mm": (7.02, 5.85, 5.29, 4.24, 4.36)}},
    ),
    "sdf": (
        ("neural",),
        {
            "shirt-male": {"mean_absolute_mm": (2.38,), "mean_relative_percent": (28.22,)},
            "tshirt-male": {"mean_absolute_mm": (2.37,), "mean_relative_percent": (25.85,)},
            "short-pant-male": {"mean_absolute_mm": (2.46,), "mean_relative_percent": (31.66,)},
            "skirt-female": {"mean_absolute_mm": (3.10,), "mean_relative_percent": (32.64,)},
        },
    ),
    "time": (
        ("sdf-approx", "sdf-accurate", "refu", "backbone"),
        {
            "shirt-male": {"ms": (1.97, 121.96, 0.29, 22.14)},
            "tshirt-male": {"ms": (1.77, 99.27, 0.28, 21.51)},
            "short-pant-male": {"ms": (1.58, 89.69, 0.21, 18.82)},
            "skirt-female": {"ms": (1.67, 107.38, 0.23, 19.76)},
            "all": {"ms": (1.75, 105.50, 0.25, 20.57)},
        },
    ),
}
"""By table: the methods, and their values by garment and metric."""

PAPER: Mapping[tuple[str, str, str, str], float] = {
    (table, garment, method, metric): value
    for table, (methods, garments) in _PRINTED.items()
    for garment, metrics in garments.items()
    for metric, values in metrics.items()
    for method, value in zip(methods, values, strict=True)
}
"""(table, garment, method, metric) to what the paper prints."""


def paper_figure(table: str, garment: str, method: str, metric: str) -> float | None:
    """What the paper prints; None where it prints nothing.

    Where it doesn't name the garment, its figure stands beside that of any of ours. Its changes against the baseline
    ("Trend") are computed anew from its own figures: the printed ones of VFCP aren't (.60 to .24 is -60 %, not -97.5
    %).
    """
    if metric.endswith("_trend"):
        value, base = (paper_figure(table, garment, m, metric[: -len("_trend")]) for m in (method, "tailornet"))
        return None if value is None or not base else 100.0 * (value - base) / base
    return PAPER.get((table, garment, method, metric), PAPER.get((table, "", method, metric)))


def published_modes() -> dict[str, dict[str, float]]:
    """The paper's modes, all garments together: `ms` of a frame on a V100, and the errors."""
    found = {}
    for mode, sdf in (("approx", "sdf-approx"), ("hybrid", "sdf-approx"), ("accurate", "sdf-accurate")):
        ms = sum(PAPER["time", "all", component, "ms"] for component in ("backbone", sdf, "refu"))
        found[mode] = {"ms": ms} | {metric: PAPER["comparison", "all", f"refu-{mode}", metric] for metric in _MAIN}
    return found
