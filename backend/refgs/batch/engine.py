"""Start Ray on this machine, or join a cluster, and let Ray run the steps of a batch (commands such as `refgs train`)."""

import atexit
import importlib.metadata
import logging
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from filelock import FileLock, Timeout

from refgs.batch.copies import Depot, remove_copies
from refgs.batch.steps import Outcome, Step, TryLater, run_step
from refgs.errors import TRY_AGAIN, InputError, TryAgain

VERSION = "2.60.0"  # pyproject.toml's
TRIES = 8  # more than once for a step whose worker died, or that said "try again"
PAUSE = 5.0  # seconds before such a step is tried again
STARTS = 4  # attempts to start Ray here: on a busy machine its parts wait for each other no longer than 15 seconds
PATIENCE = 60.0  # seconds for a cluster to answer
SILENCE = 20.0  # seconds without an answer after which the head is taken to be dead: after 60, Ray ends the process
FOLDERS, RAY = "refgs-ray-", "r"  # the first letters of a batch's folder, and Ray's in it: sockets need short names
LOCKED, NEW = "refgs.lock", 60.0  # a file in a batch's folder, and the seconds that a batch has to lock it
JOIN = "import ray, sys; ray.init(address=sys.argv[1], log_to_driver=False, logging_level='CRITICAL')"
STORE = 80 << 20  # bytes of Ray's object store: steps hand on files, not objects
MARK, READERS = "shared-", 8  # the first letters of a file that shows who shares the runs; machines that copy at once
TIDY = 10.0  # seconds for machines to remove their copies
ENVIRONMENT = {
    "RAY_USAGE_STATS_ENABLED": "0",  # tell nobody
    "RAY_worker_niceness": "0",  # commands run as fast as without Ray
    "RAY_task_oom_retries": "3",  # for ever otherwise
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "PYTHONSAFEPATH": "1",  # import nothing that lies beside the captures
}
ALONE = {  # for a Ray of this machine alone, which nobody else may use
    "RAY_AUTH_MODE": "token",
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",  # it listens on 127.0.0.1, on Linux, too
}


class Engine:
    """Run each step by Ray when its earlier steps have ended and resources are free."""

    def __init__(self, ray: Any, cores: int):
        """Use a running Ray, with `cores` per step. Raises InputError if it has none."""
        self._ray, self._depot = ray, None
        self._steps: dict[Any, Step] = {}
        self._roots: set[Path] = set()
        self._run = ray.remote(run_step)
        host, _, port = ray.get_runtime_context().gcs_address.rpartition(":")
        self._head, self._heard = (host.strip("[]"), int(port)), time.monotonic()
        nodes = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        self._cores = min(cores, int(max(node.get("CPU", 0) for node in nodes)))
        if not self._cores:
            raise InputError("no machine of the cluster lends cores: start one with ray start --address=HOST:PORT")
        self._memory = int(max(node.get("memory", 0) for node in nodes))
        self.cards = int(max(node.get("GPU", 0) for node in nodes))

    def card_bytes(self) -> int:
        """Return the memory of a CUDA card of the cluster, in bytes."""
        return self._ray.get(self._ray.remote(_card_bytes).options(num_gpus=0.01).remote())

    def submit(self, step: Step, memory: int, card: float, before: list[tuple[Any, bool]]) -> Any:
        """Hand a step to Ray. Returns a reference to its outcome.

        - `memory`: the bytes that the step needs. At most nine tenths of the largest machine's memory are requested.
        - `card`: the step's share of a CUDA card, 0 … 1
        - `before`: a pair for each step that must end first. The pair's first entry is the reference that `submit` returned for that step,
          or an `Outcome` if that step ended in an earlier batch. The second entry is True if that step may fail.
        """
        how = {
            "num_cpus": self._cores,
            "memory": min(memory, int(0.9 * self._memory)),
            "num_gpus": card,
            "max_retries": TRIES,
            "retry_exceptions": [TryLater],
            "name": f"{step.run} {step.name}",
        }
        outcomes, optional = zip(*before, strict=True) if before else ((), ())
        reference = self._run.options(**how).remote(step, self._cores, PAUSE, self._depot, optional, *outcomes)
        self._steps[reference] = step
        self._roots |= {*step.reads, *step.writes}
        return reference

    def ended(self, seconds: float) -> Iterator[tuple[Step, Outcome]]:
        """Wait until a step ends, but not longer than `seconds`. Then yield each step that has ended, with its outcome.

        Each step is yielded once. If no step has ended, none is yielded. Raises TryAgain if Ray's head has died.
        """
        if not self._steps:
            return
        self._check_head()
        try:
            references, _ = self._ray.wait(list(self._steps), timeout=seconds, num_returns=1)
        except SystemExit:  # of SIGTERM: Ray makes 1 of whatever status a signal's handler ends with
            sys.exit(TRY_AGAIN)
        if references:  # and all others that have ended by now
            references, _ = self._ray.wait(list(self._steps), timeout=0, num_returns=len(self._steps))
        for reference in references:
            yield self._steps.pop(reference), self._outcome(reference)

    def _check_head(self) -> None:
        try:
            socket.create_connection(self._head, timeout=1).close()
            self._heard = time.monotonic()
        except OSError as error:
            if time.monotonic() > self._heard + SILENCE:
                what = f"Ray's head, {self._head[0]}:{self._head[1]}, has died ({error})"
                raise TryAgain(
                    f"{what}: run the same command again; where --address is given, start the head first"
                ) from None

    def _outcome(self, reference: Any) -> Outcome:
        from ray import exceptions

        try:
            return self._ray.get(reference)
        except exceptions.TaskCancelledError:
            return Outcome(None)
        except exceptions.RayTaskError as error:
            if isinstance(error.cause, TryLater):
                return Outcome(TRY_AGAIN, what=f"{error.cause} (tried {TRIES + 1} times)")
            if isinstance(error.cause, OSError):
                return Outcome(TRY_AGAIN, what=f"a file could not be read or written ({error.cause}): mend that")
            why = str(error.cause).strip().splitlines()[:1]  # the rest is a traceback
            return Outcome(1, what=f"Ray could not run it ({''.join(why)}): see that all machines have the same refgs")
        except exceptions.RayError as error:  # its worker or machine died
            why = type(error).__name__
            return Outcome(TRY_AGAIN, what=f"its worker died {TRIES + 1} times ({why}): see that memory suffices")

    def cancel(self) -> None:
        """Stop all steps. A training that runs writes a checkpoint before it ends."""
        for reference in self._steps:
            self._ray.cancel(reference, recursive=False)  # and not what copies their files back

    @contextmanager
    def lending(self, folder: Path) -> Iterator[None]:
        """Let steps on other machines work on copies of this machine's files during a `with` block.

        `folder` is the folder of the batch's logs. A machine that can see it, as on a network disk, makes no copies. The copies are removed
        after the block. If the block raises an error, they stay for the next batch.
        """
        for old in folder.glob(f"{MARK}*"):
            old.unlink()
        mark = folder / f"{MARK}{secrets.token_hex(8)}"  # a new name: no machine remembers that there is no such file
        mark.touch()
        here = self._ray.get_runtime_context().get_node_id()
        how = {"num_cpus": 0, "scheduling_strategy": _on(here), "max_concurrency": READERS}
        self._depot = self._ray.remote(Depot).options(**how).remote(mark)
        try:
            yield
            nodes = [node["NodeID"] for node in self._ray.nodes() if node["Alive"] and node["NodeID"] != here]
            remove = self._ray.remote(remove_copies)
            how = [{"num_cpus": 0, "scheduling_strategy": _on(node)} for node in nodes]
            gone = [remove.options(**one).remote([*self._roots], mark) for one in how]
            if gone:
                self._ray.wait(gone, num_returns=len(gone), timeout=TIDY)
        finally:
            mark.unlink(missing_ok=True)


def _on(node: str) -> Any:
    """Return Ray's scheduling strategy for running a task on the node with this id."""
    from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

    return NodeAffinitySchedulingStrategy(node, soft=False)


def _card_bytes() -> int:
    import torch

    return torch.cuda.get_device_properties(0).total_memory


@contextmanager
def started(address: str | None, cores: int | None, workers: int | None) -> Iterator[Engine]:
    """Start Ray on this machine for a `with` block. With `address`, join a cluster instead.

    `address` is HOST:PORT of the cluster's head. `cores` is the number of cores of each step; None means one. `workers` is the number of
    steps that run at once on this machine; None means as many as there are cores for.

    Raises InputError if Ray is missing or has another version than VERSION, or if there is no cluster at `address`. Raises TryAgain if Ray
    cannot start on this machine.
    """
    if address and workers:
        raise InputError("--workers is for this machine: on a cluster, each machine says how many cores it lends")
    # Before Ray is imported: at exit, Ray then first ends what a failed start has left.
    folder = None if address else _make_folder()
    ray, cores = _import_ray(bool(address)), cores or 1
    quiet = {"include_dashboard": False, "log_to_driver": False, "logging_level": logging.CRITICAL}
    try:
        with _signals(None):
            if address:
                _join(ray, address)
            else:
                lent = workers * cores if workers else max(os.cpu_count() or 1, cores)
                _start(ray, quiet | {"num_cpus": lent, "object_store_memory": STORE, "_temp_dir": f"{folder}/{RAY}"})
        yield Engine(ray, cores)
    finally:
        with _signals(signal.SIG_IGN):  # stopped half way, Ray waits for a minute and ends this process with 1
            _keep_ignoring(ray)
            ray.shutdown()


def _keep_ignoring(ray: Any) -> None:
    """Ignore SIGTERM until Ray's shutdown ends, although Ray restores the default handler."""
    node = ray._private.worker._global_node
    if node is None or threading.current_thread() is not threading.main_thread():
        return
    kill = node.kill_all_processes

    def ignore_and_kill(*words: Any, **more: Any) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        kill(*words, **more)

    node.kill_all_processes = ignore_and_kill


@contextmanager
def _signals(handler: Any) -> Iterator[None]:
    """Set the SIGINT and SIGTERM handlers for a `with` block; None only restores them afterwards."""
    numbers = (signal.SIGINT, signal.SIGTERM) if threading.current_thread() is threading.main_thread() else ()
    before = {number: signal.getsignal(number) for number in numbers}
    try:
        if handler is not None:
            for number in numbers:
                signal.signal(number, handler)
        yield
    finally:
        for number, one in before.items():
            signal.signal(number, one)


def _make_folder() -> Path:
    """Make a private folder for Ray until exit; remove folders that killed batches left."""
    parent = Path("/tmp" if os.name == "posix" else tempfile.gettempdir())  # names of sockets must be short
    for old in parent.glob(f"{FOLDERS}*"):
        with suppress(OSError, Timeout):
            if _is_left(old):
                with FileLock(old / LOCKED, timeout=0):  # its batch has ended
                    shutil.rmtree(old, ignore_errors=True)
    folder = Path(tempfile.mkdtemp(prefix=FOLDERS, dir=parent))
    lock = FileLock(folder / LOCKED)
    lock.acquire()
    atexit.register(_remove, folder, lock)
    return folder


def _remove(folder: Path, lock: FileLock) -> None:
    """Remove a batch's folder, trying for TIDY seconds while Ray's processes end."""
    until = time.monotonic() + TIDY
    while (folder / RAY).exists() and time.monotonic() < until:
        shutil.rmtree(folder / RAY, ignore_errors=True)
        time.sleep(0.1)
    lock.release()
    shutil.rmtree(folder, ignore_errors=True)


def _is_left(folder: Path) -> bool:
    """Return True if a folder looks left by a killed batch; callers test its lock."""
    # A younger folder may belong to a batch that has not locked it yet.
    facts = folder.stat()
    own = not hasattr(os, "getuid") or facts.st_uid == os.getuid()
    return own and time.time() > facts.st_mtime + NEW and {file.name for file in folder.iterdir()} <= {LOCKED, RAY}


def _import_ray(cluster: bool) -> Any:
    """Set Ray's environment and import it. Raises InputError unless Ray VERSION is installed."""
    os.environ.update({name: value for name, value in ENVIRONMENT.items() if name not in os.environ})
    if not cluster:  # no token need be kept for it
        os.environ.update(ALONE | {"RAY_AUTH_TOKEN": secrets.token_hex(32)})
    try:
        found = importlib.metadata.version("ray")
    except importlib.metadata.PackageNotFoundError:
        raise InputError("refgs batch needs Ray: pip install 'refgs[farm]'") from None
    if found != VERSION:
        raise InputError(f"Ray {found} is installed, and refgs batch needs {VERSION}: pip install 'refgs[farm]'")
    import ray
    import ray._private.worker

    # It prints what its own processes log when a worker dies. The steps have logs, and their last lines are reported.
    ray._private.worker.print_to_stdstream = lambda *_, **__: None
    return ray


class _NoPaths(list):
    """Keep empty the list of folders from which Ray's workers import modules."""

    def extend(self, _: Any) -> None:
        pass


def _without_paths() -> Any:
    from ray.job_config import JobConfig

    config = JobConfig()
    config._py_driver_sys_path = _NoPaths()
    return config


def _start(ray: Any, how: dict[str, Any]) -> None:
    for attempt in range(STARTS):
        try:
            ray.init(address="local", job_config=_without_paths(), **how)
            return
        except Exception as error:  # Ray raises whatever its parts meet
            ray.shutdown()
            why = str(error).splitlines()[0]
            if attempt == STARTS - 1:
                raise TryAgain(f"Ray does not start here ({why}): wait until the machine is less busy") from None


def _join(ray: Any, address: str) -> None:
    host, _, port = address.rpartition(":")
    nobody = f"--address {address}: no Ray cluster is there"
    if not host or not port.isdigit():
        raise InputError(f"--address {address}: write it as HOST:PORT, as `ray start --head` names it")
    try:
        socket.create_connection((host, int(port)), timeout=5).close()
        # First in another process: with what is not Ray, this takes minutes, in which it cannot be interrupted.
        tried = subprocess.run(
            [sys.executable, "-P", "-c", JOIN, address], capture_output=True, text=True, timeout=PATIENCE
        )
    except subprocess.TimeoutExpired:
        raise InputError(f"{nobody} that answers: start one with ray start --head") from None
    except (OSError, OverflowError) as error:
        raise InputError(f"{nobody} ({error}): start one with ray start --head") from None
    if "ersion mismatch" in tried.stderr:
        here = f"{VERSION} and {sys.version.split()[0]}"
        raise InputError(f"--address {address}: Ray or Python is another version there than here, {here}: install one")
    if tried.returncode:
        why = next(reversed(tried.stderr.strip().splitlines()), "")[:200]
        raise InputError(
            f"--address {address}: this machine cannot join ({why}): run this on one of the cluster's, with its token"
        )
    ray.init(address=address, job_config=_without_paths(), log_to_driver=False, logging_level=logging.CRITICAL)
