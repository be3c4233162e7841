"""Build the two Blender extensions for release.

    python scripts/build_extension.py [FOLDER] [--bare] [--website URL] [--maintainer "NAME <ADDRESS>"]      # into dist/

- `refgs` imports, edits, relights and exports. One zip serves all platforms. It needs nothing but Blender.
- `refgs_trainer` adds the training to it. There is a zip for each platform, which holds the trainer as a Python wheel, and uv, a package
  installer, which later installs the trainer. It also holds the locks: the version and the SHA-256 of every package that the trainer
  needs, on every platform and Python. They name no address. With `--bare` there is one zip without all that, for those who choose a
  Python that has the trainer.

Blender's own tool builds and validates the zips. The tool comes with Blender's Python module, uv with the tests' packages
(`pip install -e ".[test]"`). There is no zip for macOS on Intel, because torch is no longer built for it.

docs/hosting.md describes how to publish them. extensions.blender.org wants a website and a maintainer with an address: only who
publishes knows them.
"""

import argparse
import importlib.util
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
import tomllib
from importlib.metadata import version
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PLATFORMS = {"linux-x64": "manylinux2014_x86_64", "windows-x64": "win_amd64", "macos-arm64": "macosx_11_0_arm64"}
TORCH_BUILDS = ("cpu", "cu126", "cu128", "cu129", "cu130", "cu132")  # as uv names them; each has an index of its own
LARGEST = 150e6  # bytes of a zip, at most


def call(*arguments: str | Path) -> tuple[int, str]:
    """Run Python with these command-line arguments. Return its exit status and its output."""
    environment = {name: value for name, value in os.environ.items() if name != "UV_TORCH_BACKEND"}
    words = [sys.executable, *arguments]
    done = subprocess.run(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)
    return done.returncode, done.stdout


def run(*arguments: str | Path) -> None:
    """Run Python with these command-line arguments. If it fails, exit and show its output."""
    status, said = call(*arguments)
    if status != 0:
        sys.exit(f"{' '.join(map(str, arguments))}\n{said}")


def blender_tool() -> Path:
    """Find the script with which Blender builds extensions; it is part of the module bpy."""
    bpy = importlib.util.find_spec("bpy")
    if bpy is None:
        sys.exit('Blender\'s Python module is missing: pip install -e ".[blender]"')
    return next(Path(bpy.origin).parent.glob("*/scripts/addons_core/bl_pkg/cli/blender_ext.py"))


def build_trainer(source: Path, wheels: Path) -> None:
    """Build the trainer's wheel, with its presets and its segmentation model, and write it into the folder `wheels`.

    The code is first copied into the folder `source`, without files that earlier builds left.
    """
    shutil.copytree(ROOT / "backend", source / "backend", ignore=shutil.ignore_patterns("*.egg-info", "__pycache__"))
    shutil.copytree(ROOT / "presets", source / "backend" / "refgs" / "presets")
    for name in ("pyproject.toml", "README.md", "LICENSE"):
        shutil.copy(ROOT / name, source)
    run("-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", wheels, source)


def write_locks(project: Path, folder: Path) -> None:
    """Lock the packages that a `project`, a pyproject.toml with the extras `farm` and `learned`, needs now. Write the locks into a folder.

    `lock.txt` is for torch of the package index, `lock-BUILD.txt` for a build of torch that has an index of its own. A build that does not
    exist, or whose index cannot be reached, gets none: machines that it is for then take torch from the package index.
    """
    how = ["-m", "uv", "pip", "compile", project, "--project", project.parent, "--extra", "farm", "--extra", "learned"]
    how += ["--universal", "--python-version", "3.11"]
    how += ["--generate-hashes", "--only-binary", ":all:", "--no-header", "--no-annotate", "--quiet"]
    run(*how, "--output-file", folder / "lock.txt")
    for build in TORCH_BUILDS:
        status, said = call(*how, "--output-file", folder / f"lock-{build}.txt", "--torch-backend", build)
        if status != 0:
            print(f"no lock for torch's build {build}: {said.partition(chr(10))[0]}")
    for lock in folder.glob("lock*.txt"):
        if "://" in lock.read_text(encoding="utf-8"):
            sys.exit(f"{lock.name} names an address: let every package come from an index")


def stage(folder: Path, facts: dict[str, str]) -> None:
    """Assemble the extension `refgs` in `folder`, ready to be zipped. `facts` are entries for its manifest.

    The manifest lists what the zip leaves out.
    """
    for name in ("refgs_addon", "docs"):
        shutil.copytree(ROOT / name, folder / name)
    for name in ("__init__.py", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    write_manifest(ROOT, folder, facts)


def stage_trainer(folder: Path, facts: dict[str, str], wheels: Path | None) -> None:
    """Assemble the extension `refgs_trainer` in `folder`, ready to be zipped. `facts` are entries for its manifest.

    The files in `wheels` are the trainer and uv, of each platform, and the locks.
    """
    ignore = shutil.ignore_patterns("__pycache__")
    shutil.copytree(ROOT / "refgs_trainer", folder, ignore=ignore)
    shutil.copytree(ROOT / "refgs_addon" / "trainer", folder / "trainer", ignore=ignore)
    shutil.copy(ROOT / "LICENSE", folder)
    lists = {}
    if wheels is not None:
        shutil.copytree(wheels, folder / "wheels")
        # Blender installs listed wheels into its own Python. List uv's, not the trainer's, which needs torch.
        listed = sorted(f"./wheels/{file.name}" for file in wheels.glob("uv-*.whl"))
        lists = {"platforms": list(PLATFORMS), "wheels": listed}
    write_manifest(ROOT / "refgs_trainer", folder, facts | lists)


def write_manifest(source: Path, folder: Path, facts: dict[str, str | list[str]]) -> None:
    """Copy an extension's manifest from the folder `source`, with `facts` as entries of its head."""
    manifest = (source / "blender_manifest.toml").read_text(encoding="utf-8")
    for key, value in facts.items():
        manifest = re.sub(rf"(?m)^{key} = .*\n", "", manifest)
        first_table = manifest.index("\n[") + 1
        manifest = f"{manifest[:first_table]}{key} = {json.dumps(value)}\n\n{manifest[first_table:]}"
    assert tomllib.loads(manifest).items() >= facts.items()
    (folder / "blender_manifest.toml").write_text(manifest, encoding="utf-8")


def zip_extension(source: Path, folder: Path, *options: str) -> list[Path]:
    """Zip the extension assembled in `source` into the new `folder`, and validate the zips. Returns their paths."""
    folder.mkdir()
    run(blender_tool(), "build", "--source-dir", source, "--output-dir", folder, *options)
    archives = sorted(folder.glob("*.zip"))
    for archive in archives:
        run(blender_tool(), "validate", archive)
    return archives


def collect_wheels(folder: Path) -> Path:
    """Write the trainer's wheel, uv's of each platform and the locks into a new folder in `folder`. Returns its path."""
    wheels = folder / "wheels"
    for tag in PLATFORMS.values():
        only = ("--only-binary", ":all:", "--platform", tag)
        run("-m", "pip", "download", "--quiet", "--no-deps", *only, "--dest", wheels, f"uv=={version('uv')}")
    run(ROOT / "scripts" / "fetch_model.py")
    build_trainer(folder / "source", wheels)
    write_locks(ROOT / "pyproject.toml", wheels)
    return wheels


def main() -> None:
    parser = argparse.ArgumentParser(description="Build the two Blender extensions for release.")
    parser.add_argument("out", nargs="?", type=Path, default=ROOT / "dist", help="folder for the zips")
    parser.add_argument("--bare", action="store_true", help="leave out the trainer's packages and their installer")
    parser.add_argument("--website", help="address of the website that the extensions name")
    parser.add_argument("--maintainer", help="name and address of who publishes them")
    options = parser.parse_args()
    facts = {key: value for key in ("website", "maintainer") if (value := getattr(options, key))}
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        (folder / "refgs").mkdir()
        stage(folder / "refgs", facts)
        stage_trainer(folder / "refgs_trainer", facts, None if options.bare else collect_wheels(folder))
        archives = zip_extension(folder / "refgs", folder / "zip")
        split = () if options.bare else ("--split-platforms",)
        archives += zip_extension(folder / "refgs_trainer", folder / "zips", *split)
        for archive in archives:
            size = archive.stat().st_size
            if size > LARGEST:
                sys.exit(
                    f"{archive.name} has {size / 1e6:.1f} MB, more than the {LARGEST / 1e6:.0f} that a zip may have"
                )
            shutil.copy(archive, options.out)
            print(f"{options.out / archive.name}: {size / 1e6:.1f} MB")
    for key in ("website", "maintainer"):
        if key not in facts:
            print(f"extensions.blender.org wants --{key}")


if __name__ == "__main__":
    main()
