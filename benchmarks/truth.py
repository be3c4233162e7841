"""Measure the method on scenes with ground truth: `refgs bench truth --scenes DIR`.

Each scene is trained twice. The first run uses a preset; its normals, materials, light and relit images are compared with the ground truth.
The second run has plain view-dependent colour (`shading=sh`) and takes as long as the first. Both runs are compared on novel views.
"""

import argparse
from collections.abc import Sequence

from benchmarks.harness import Bench, Column, Table, Variant, figures, relit, scene_options
from benchmarks.scenes import REFLECTIVE

TABLES = (
    Table(
        "where the truth is known",
        "truth",
        (
            Column("PSNR dB", "psnr", ".1f", "deferred"),
            Column("`sh`", "psnr", ".1f", "sh"),
            Column("SSIM", "ssim", ".3f", "deferred"),
            Column("normals °", "normals", ".1f", "deferred"),
            Column("base colour dB", "albedo", ".1f", "deferred"),
            Column("roughness", "roughness", ".3f", "deferred"),
            Column("metallic", "metallic", ".3f", "deferred"),
            Column("wrong", "wrong", ".1%", "deferred"),
            Column("light log-RMSE", "light", ".2f", "deferred"),
            Column("relit dB", "relit", ".1f", "deferred"),
            Column("aligned dB", "relit_aligned", ".1f", "deferred"),
            Column("CPU s", "seconds", ".0f", "deferred"),
        ),
        mean=REFLECTIVE,
    ),
)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train and evaluate all runs that are not finished yet. Print the errors of each scene against its ground truth."""
    parser = scene_options(argparse.ArgumentParser(description=__doc__.splitlines()[0]), preset="standard")
    bench = Bench("truth", parser, arguments)
    preset = ("--preset", bench.options.preset)
    variants = {"deferred": Variant(preset), "sh": Variant((*preset, "--set", "shading=sh"), "deferred")}
    for scene, runs in bench.runs(variants):
        for variant, run in runs.items():
            record(bench, scene, variant, figures(run))
    bench.finish(*TABLES)


def record(bench: Bench, scene: str, variant: str, metrics: dict) -> None:
    """Add a run's metrics to the rows of `bench`. `metrics` is the run's metrics.json.

    A run with plain view-dependent colour has no metrics of materials and light.
    """
    bench.record(scene, variant, "dB", psnr=metrics["psnr"], albedo=metrics.get("albedo", {}).get("psnr_aligned"))
    bench.record(scene, variant, "dB", relit=relit(metrics, "psnr_raw"), relit_aligned=relit(metrics, "psnr_aligned"))
    bench.record(scene, variant, "°", normals=metrics.get("normal_mae_degrees"))
    bench.record(scene, variant, "", ssim=metrics.get("ssim"), light=metrics.get("environment", {}).get("log_rmse"))
    bench.record(scene, variant, "", roughness=metrics.get("roughness_mae"), metallic=metrics.get("metallic_mae"))
    bench.record(scene, variant, "", wrong=metrics.get("metallic_wrong"))
    bench.record(scene, variant, "s", seconds=metrics.get("processor_seconds"))
