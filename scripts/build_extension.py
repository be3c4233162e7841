"""Build the Blender extension for release: one zip for each platform.

    python scripts/build_extension.py [FOLDER]      # into dist/

Each zip holds the add-on's code, the trainer as a Python wheel, and uv, a package installer, which later installs the trainer. It also
holds the locks: the version and the SHA-256 of every package that the trainer needs, on every platform and Python. They name no address.

Blender's own tool builds and validates the zips. The tool comes with Blender's Python module, uv with the tests' packages
(`pip install -e ".[test]"`). There is no zip for macOS on Intel, because torch is no longer built for it.

To build a zip without the trainer, for any platform, run `blender --command extension build` instead.
"""

import importlib.util
import os
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


def stage(folder: Path, wheels: Path) -> None:
    """Assemble the extension in `folder`, ready to be zipped: the add-on's code, the files in `wheels`, and the manifest.

    The manifest lists the platforms and the wheels of uv, which Blender then installs.
    """
    shutil.copytree(ROOT / "refgs_addon", folder / "refgs_addon", ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copytree(ROOT / "docs", folder / "docs")
    for name in ("__init__.py", "LICENSE"):
        shutil.copy(ROOT / name, folder)
    shutil.copytree(wheels, folder / "wheels")
    # Blender installs listed wheels into its own Python. List uv's, not the trainer's, which needs torch.
    listed = sorted(f"./wheels/{file.name}" for file in wheels.glob("uv-*.whl"))
    manifest = (ROOT / "blender_manifest.toml").read_text(encoding="utf-8")
    first_table = manifest.index("\n[") + 1
    lines = f"platforms = {list(PLATFORMS)}\nwheels = {listed}\n\n"
    manifest = manifest[:first_table] + lines + manifest[first_table:]
    assert tomllib.loads(manifest)["wheels"] == listed
    (folder / "blender_manifest.toml").write_text(manifest, encoding="utf-8")


def main() -> None:
    out = Path(sys.argv[1] if len(sys.argv) > 1 else ROOT / "dist")
    out.mkdir(parents=True, exist_ok=True)
    tool = blender_tool()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        wheels = folder / "wheels"
        for tag in PLATFORMS.values():
            only = ("--only-binary", ":all:", "--platform", tag)
            run("-m", "pip", "download", "--quiet", "--no-deps", *only, "--dest", wheels, f"uv=={version('uv')}")
        run(ROOT / "scripts" / "fetch_model.py")
        build_trainer(folder / "trainer", wheels)
        write_locks(ROOT / "pyproject.toml", wheels)
        stage(folder / "extension", wheels)
        built = folder / "built"
        built.mkdir()
        run(tool, "build", "--source-dir", folder / "extension", "--output-dir", built, "--split-platforms")
        for archive in sorted(built.glob("*.zip")):
            run(tool, "validate", archive)
            size = archive.stat().st_size
            if size > LARGEST:
                sys.exit(
                    f"{archive.name} has {size / 1e6:.1f} MB, more than the {LARGEST / 1e6:.0f} that a zip may have"
                )
            shutil.copy(archive, out)
            print(f"{out / archive.name}: {size / 1e6:.1f} MB")


if __name__ == "__main__":
    main()
