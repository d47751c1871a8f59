"""Runs many items through three stages, in this process, in worker processes of this machine, or on a Dask cluster.

The caller supplies the stages. Within a process they overlap: while one item is computed, the next ones are read and
the last one is written. An item that fails, or kills its process, does not affect the others.
"""

from __future__ import annotations

import contextlib
import itertools
import logging
import multiprocessing
import os
import pickle
import queue
import signal
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import Future
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from types import FrameType
from typing import Any

from whitefurnace.errors import (
    CheckError,
    DeviceError,
    FileError,
    UnsupportedError,
    UsageError,
    WhitefurnaceError,
    code_of,
)
from whitefurnace.opencl.device import core_limit, cores
from whitefurnace.version import VERSION

MOST_WORKERS = 1024
RESOURCE = "OPENCL"
# Share of a worker's OPENCL=1 that an item takes: four items, one in each stage and one waiting, fill its pipeline.
# It is a binary fraction, so that four add up to exactly one.
SHARE = 0.25
# Number of items submitted for each Dask worker: two more than it works on, so that it never waits for the network.
# More would only have to be finished after Ctrl-C.
WINDOW = 6
# The first worker builds the kernels alone. The others start after this many results or seconds where it builds none,
# because all items were up to date, or hangs.
FIRST = 8
FIRST_SECONDS = 30.0
CONNECT_SECONDS = 10  # time for a scheduler to answer
TICK = 0.1  # seconds between two checks for events that send no message: Ctrl-C, a lost scheduler
LIMITS = (0.1, 1e7)  # of the seconds that an item may take
ENDING = tuple(getattr(signal, name) for name in ("SIGTERM", "SIGHUP") if hasattr(signal, name))
PATIENCE = 3.0  # seconds that a stage may take to end after the second Ctrl-C, before its process is killed


@dataclass(frozen=True)
class Stages:
    """The functions that run an item. They are functions of modules, so that other processes find them by name.

    prepare  prepare(item) reads its input
    compute  compute(prepared) is the only stage that uses the device, and runs in one thread
    write    write(computed) stores its output and returns its result
    abandon  abandon(prepared or computed) releases an item that will not be finished
    failed   failed(item, message, exit_code) returns the result of a failure that the pool detects
    result   the type of results; prepare and compute may return one too, which ends the item
    load     load(item) returns the item as it is sent to a cluster
    Items and results must be small and picklable.
    """

    prepare: Callable[[Any], Any]
    compute: Callable[[Any], Any]
    write: Callable[[Any], Any]
    abandon: Callable[[Any], None]
    failed: Callable[..., Any]
    result: type
    load: Callable[[Any], Any] | None = None


def run(
    stages: Stages,
    items: Iterable[Any],
    *,
    workers: int = 1,
    scheduler: str | None = None,
    limit: float | None = None,
    on_result: Callable[[Any], None],
    on_notice: Callable[[str], None] | None = None,
    stop: threading.Event | None = None,
) -> None:
    """Run every item through the stages.

    items: taken one by one as there is room, so it may be endless. workers: 1 runs in this process, more in as many
    processes with equal shares of the cores. scheduler: address of a Dask scheduler, whose workers with the resource
    OPENCL run the items. limit: seconds that an item may take in its stages; the worker of one that takes longer is
    killed and replaced, and the item fails. With a limit even one worker is a process of its own, because nothing else
    ends a call of a driver. on_result is called with each result, in order of completion, in this thread; on_notice
    with sentences about the run. stop: an event that ends the run as Ctrl-C does.
    The first Ctrl-C finishes the items in flight, a second one abandons them; both raise KeyboardInterrupt at the end.
    Raises UsageError for invalid arguments, UnsupportedError without Dask or with another version of this package on a
    worker, FileError where no scheduler answers or it is lost, and DeviceError where worker processes cannot start.
    An exception of `items` is raised after the items in flight have ended.
    """
    if not 1 <= workers <= MOST_WORKERS:
        raise UsageError(f"the number of workers is {workers}, outside [1, {MOST_WORKERS}]")
    if scheduler is not None and workers != 1:
        raise UsageError("give a number of workers or a scheduler, not both: a cluster has its own workers")
    if limit is not None:
        checked_limit(limit)
        if scheduler is not None:
            raise UsageError("a time limit of items needs worker processes of this machine: give workers, no scheduler")
    report = on_notice or (lambda text: None)
    with _Interrupts(stop or threading.Event(), report) as interrupts:
        if scheduler is not None:
            _on_cluster(stages, items, scheduler, on_result, report, interrupts)
        elif workers > 1 or limit is not None:
            _Crew(stages, items, workers, limit, on_result, report, interrupts).run()
        else:
            _here(stages, items, on_result, interrupts)
        if interrupts.count:
            raise KeyboardInterrupt


def checked_limit(seconds: Any) -> float:
    """Return a time limit of items. Raises UsageError where it is no number of seconds in LIMITS."""
    number = isinstance(seconds, int | float) and not isinstance(seconds, bool)
    if not number or not LIMITS[0] <= seconds <= LIMITS[1]:
        raise UsageError(f"a time limit of {seconds!r} is not a number of seconds in [{LIMITS[0]:g}, {LIMITS[1]:g}]")
    return float(seconds)


class _Interrupts:
    """Handles Ctrl-C within a `with` block: the first sets `stop`, the second raises KeyboardInterrupt."""

    def __init__(self, stop: threading.Event, report: Callable[[str], None]) -> None:
        self.stop = stop
        self.count = 0
        self._report = report
        self._reported = False
        self._before: Any = None
        self.main = threading.current_thread() is threading.main_thread()

    def __enter__(self) -> _Interrupts:
        if self.main:
            self._before = signal.signal(signal.SIGINT, self._heard)
        return self

    def __exit__(self, *_: object) -> None:
        if self.main:
            signal.signal(signal.SIGINT, signal.SIG_DFL if self._before is None else self._before)

    def _heard(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        self.stop.set()
        if self.count > 1:
            raise KeyboardInterrupt

    def look(self) -> bool:
        """Return whether no new item may begin, and report it once. The signal handler itself must not report."""
        if self.count and not self._reported:
            self._reported = True
            self._report("finishing what is in flight; Ctrl-C again stops it")
        return self.stop.is_set()

    @staticmethod
    @contextlib.contextmanager
    def held() -> Iterator[None]:
        """Block Ctrl-C while a process starts, until the process can ignore it.

        Ctrl-C reaches all processes of a terminal. A new process inherits the block, and this process gets a blocked
        signal later.
        """
        if not hasattr(signal, "pthread_sigmask"):
            yield
            return
        resource_tracker.ensure_running()  # started by multiprocessing later, it would unblock the signal
        before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            yield
        finally:
            signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _message(error: BaseException) -> str:
    """Describe an exception in one line, with its class unless it is an error of this package with a sentence."""
    text = " ".join(str(error).split())
    return text if isinstance(error, WhitefurnaceError) and text else f"{type(error).__name__}: {text}".rstrip(": ")


# ---------------------------------------------------------------------------------------------- in a process


class Pipeline:
    """Reads, computes and writes consecutive items at the same time, in three threads.

    At most two items are read ahead (one of them still being read), and two follow (one being written).
    source: returns the next (ticket, item), or None at the end. emit: called with (ticket, item, result) when an item
    ends, in any of the three threads. watch: called with (ticket, True) where a stage of an item begins and (ticket,
    False) where it ends.
    """

    def __init__(
        self,
        stages: Stages,
        source: Callable[[], tuple[int, Any] | None],
        emit: Callable[[int, Any, Any], None],
        watch: Callable[[int, bool], None] = lambda ticket, begins: None,
    ) -> None:
        self._watch = watch
        self._stages = stages
        self._source = source
        self._emit = emit
        self._ahead: queue.Queue[tuple[int, Any] | None] = queue.Queue(1)
        self._behind: queue.Queue[tuple[int, Any] | None] = queue.Queue(1)
        self._held: dict[int, Any] = {}  # by ticket, the output of a stage until the next stage takes it
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._failure: BaseException | None = None

    def run(self, idle: Callable[[], None] = lambda: None) -> None:
        """Compute in the calling thread until the source ends; call `idle` between items and every 0.1 s.

        An exception of the source or of `emit` is raised after all items. If this thread is interrupted, all items are
        abandoned.
        """
        reader = threading.Thread(target=self._read, name="read", daemon=True)
        writer = threading.Thread(target=self._write, name="write", daemon=True)
        try:  # a signal may come while a thread starts
            reader.start()
            writer.start()
            while True:
                try:
                    job = self._ahead.get(timeout=TICK)
                except queue.Empty:
                    idle()
                    continue
                if job is None:
                    break
                ticket, item = job
                done = self._stage(self._stages.compute, self._held[ticket], ticket, item)
                while not done:
                    try:
                        self._behind.put(job, timeout=TICK)
                        break
                    except queue.Full:
                        idle()
                idle()
            while writer.is_alive():
                with contextlib.suppress(queue.Full):
                    self._behind.put(None, timeout=TICK)
                    break
                idle()
            while writer.is_alive():
                writer.join(TICK)
                idle()
            idle()
        except BaseException:
            self._close(reader, writer)
            raise
        if self._failure is not None:
            raise self._failure

    def _stage(self, stage: Callable[[Any], Any], value: Any, ticket: int, item: Any) -> bool:
        """Run a stage of an item and hold its output; return whether the item has ended."""
        self._watch(ticket, True)
        try:
            given = stage(value)
        except Exception as error:  # it fails this item alone
            if stage is not self._stages.prepare:
                self._undo(value)
            given = self._stages.failed(item, _message(error), code_of(error))
        self._watch(ticket, False)
        with self._lock:
            if not isinstance(given, self._stages.result) and not self._closed.is_set():
                self._held[ticket] = given
                return False
            self._held.pop(ticket, None)
        if isinstance(given, self._stages.result):
            self._emit(ticket, item, given)
        else:
            self._undo(given)
        return True

    def _read(self) -> None:
        """Take items from the source and prepare them: the reading thread."""
        try:
            while not self._closed.is_set() and (job := self._source()) is not None:
                if self._stage(self._stages.prepare, job[1], *job):
                    continue
                while not self._closed.is_set():
                    with contextlib.suppress(queue.Full):
                        self._ahead.put(job, timeout=TICK)
                        break
        except BaseException as error:
            self._failure = error
        while not self._closed.is_set():
            with contextlib.suppress(queue.Full):
                self._ahead.put(None, timeout=TICK)
                return

    def _write(self) -> None:
        """Write computed items: the writing thread."""
        while not self._closed.is_set():
            try:
                job = self._behind.get(timeout=TICK)
            except queue.Empty:
                continue
            if job is None:
                return
            with self._lock:
                if self._closed.is_set():
                    return
                value = self._held.pop(job[0])
            try:
                self._stage(self._stages.write, value, *job)
            except BaseException as error:  # raised by emit
                self._failure = error

    def _undo(self, value: Any) -> None:
        with contextlib.suppress(Exception):
            self._stages.abandon(value)

    def _close(self, *threads: threading.Thread) -> None:
        """Abandon what waits, and let the items that are being read and written end: they hold locks and files."""
        with self._lock:
            self._closed.set()
            held, self._held = list(self._held.values()), {}
        for value in held:
            self._undo(value)
        deadline = time.monotonic() + PATIENCE
        for thread in threads:
            if thread.ident is not None:  # it was started
                thread.join(max(deadline - time.monotonic(), 0))


def _here(stages: Stages, items: Iterable[Any], on_result: Callable[[Any], None], interrupts: _Interrupts) -> None:
    """Run all items in one pipeline of this process. It computes in this thread, which receives Ctrl-C."""
    source = enumerate(items)
    results: queue.SimpleQueue[Any] = queue.SimpleQueue()

    def idle() -> None:
        interrupts.look()
        with contextlib.suppress(queue.Empty):
            while True:
                on_result(results.get_nowait())

    pipeline = Pipeline(
        stages,
        lambda: None if interrupts.stop.is_set() else next(source, None),
        lambda ticket, item, result: results.put(result),
    )
    try:
        pipeline.run(idle)
    finally:
        idle()


# ---------------------------------------------------------------------------------------------- worker processes


def _serve(stages: Stages, connection: Connection) -> None:
    """Run a worker process: request an item whenever one can be read, until the connection closes or a signal comes."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # it was blocked while this process started
    for number in ENDING:
        if signal.getsignal(number) == signal.SIG_DFL:  # nohup ignores SIGHUP
            signal.signal(number, _leave)
    sending = threading.Lock()
    warm = False

    def send(kind: str, ticket: int, value: bytes | str) -> None:
        with sending, contextlib.suppress(OSError):  # the connection is closed, which also ends the source
            connection.send_bytes(pickle.dumps((kind, ticket, value)))

    def source() -> tuple[int, Any] | None:
        while True:
            send("next", 0, "")
            try:
                ticket, blob = pickle.loads(connection.recv_bytes())
            except (EOFError, OSError):
                return None
            try:
                return ticket, pickle.loads(blob)
            except Exception as error:
                send("failed", ticket, f"a worker cannot read the item: {_message(error)}")

    def emit(ticket: int, item: Any, result: Any) -> None:
        try:
            blob = pickle.dumps(result)
        except Exception as error:
            send("failed", ticket, f"its result cannot be sent: {_message(error)}")
        else:
            send("result", ticket, blob)

    def idle() -> None:
        nonlocal warm
        if not warm and computed.is_set():
            warm = True
            send("warm", 0, "")

    computed = threading.Event()
    pipeline = Pipeline(
        _Marked(stages, computed).stages(),
        source,
        emit,
        lambda ticket, begins: send("begins" if begins else "rests", ticket, ""),
    )
    pipeline.run(idle)


@dataclass(frozen=True)
class _Marked:
    """Stages that set an event when the first computation has ended, which includes the build of the kernels."""

    inner: Stages
    computed: threading.Event

    def stages(self) -> Stages:
        def compute(value: Any) -> Any:
            try:
                return self.inner.compute(value)
            finally:
                self.computed.set()

        return Stages(
            self.inner.prepare, compute, self.inner.write, self.inner.abandon, self.inner.failed, self.inner.result
        )


def _leave(number: int, frame: FrameType | None) -> None:
    """End a worker process after a signal."""
    for other in ENDING:  # a second one would stop the cleaning
        signal.signal(other, signal.SIG_IGN)
    raise SystemExit(128 + number)


class _Worker:
    """A worker process and the items that it has."""

    def __init__(self, number: int, process: Any, connection: Connection) -> None:
        self.number = number
        self.process = process
        self.connection = connection
        self.items: dict[int, Any] = {}
        self.spent: dict[int, float] = {}  # by ticket, seconds in stages that have ended
        self.since: dict[int, float] = {}  # by ticket, when the stage began that it is in
        self.wants = False
        self.heard = False
        self.alone = False  # its item was with a worker that died, so it gets no other

    def clock(self, kind: str, ticket: int) -> None:
        """Note that a stage of an item begins or ends."""
        if kind == "begins":
            self.since[ticket] = time.monotonic()
        else:
            self.spent[ticket] = self.seconds(ticket)
            self.since.pop(ticket, None)

    def seconds(self, ticket: int) -> float:
        """Return the time that an item has taken in its stages; not that in which it waited for them."""
        now = time.monotonic()
        return self.spent.get(ticket, 0.0) + now - self.since.get(ticket, now)


class _Crew:
    """The worker processes of a run."""

    def __init__(
        self,
        stages: Stages,
        items: Iterable[Any],
        count: int,
        limit: float | None,
        on_result: Callable[[Any], None],
        report: Callable[[str], None],
        interrupts: _Interrupts,
    ) -> None:
        self.stages = stages
        self.source = enumerate(items)
        self.count = count
        self.limit = limit
        self.on_result = on_result
        self.report = report
        self.interrupts = interrupts
        self.workers: list[_Worker] = []
        self.again: deque[tuple[int, Any]] = deque()  # items whose worker died
        self.back: deque[tuple[int, Any]] = deque()  # items whose worker was killed for another item
        self.ended = False  # whether the source has ended
        self.failure: BaseException | None = None
        self.warm = False
        self.results = 0
        self.stillborn = 0
        self.began = time.monotonic()

    def run(self) -> None:
        try:
            for number in range(self.count):
                self.workers.append(self._start(number))
            while True:
                stopping = self.interrupts.look()
                if not stopping:
                    self._hand_out()
                left = self.again or self.back or not self.ended
                if not any(worker.items for worker in self.workers) and (stopping or not left):
                    break
                self._listen()
        except BaseException:
            self._end(at_once=True)
            raise
        self._end(at_once=False)
        if self.failure is not None:
            raise self.failure

    def _start(self, number: int) -> _Worker:
        context = multiprocessing.get_context("spawn")  # the fork of a process that has loaded OpenCL hangs
        ours, theirs = context.Pipe()
        # Where the cores do not divide evenly, the first few workers get one more.
        share = max(cores() // self.count + (number < cores() % self.count), 1)
        process = context.Process(
            target=_serve, args=(self.stages, theirs), name=f"whitefurnace worker {number}", daemon=True
        )
        with self.interrupts.held(), _environment(core_limit(share)):
            process.start()
        theirs.close()
        return _Worker(number, process, ours)

    def _next(self) -> tuple[int, Any] | None:
        if self.back:
            return self.back.popleft()
        if self.ended:
            return None
        try:
            job = next(self.source, None)
        except Exception as error:  # raised after the items in flight
            job, self.failure = None, error
        self.ended = job is None
        return job

    def _hand_out(self) -> None:
        """Give an item to each worker that can read one: new items first, then those whose worker died."""
        for worker in self.workers:
            # The first worker starts alone: the kernels that it builds are then in the compiler's cache for the others.
            self.warm = self.warm or time.monotonic() - self.began > FIRST_SECONDS
            if not worker.wants or worker.alone or (worker.number and not self.warm):
                continue
            job = self._next()
            if job is None and self.again and not worker.items:
                job, worker.alone = self.again.popleft(), True
            if job is None:
                continue
            ticket, item = job
            try:
                blob = pickle.dumps((ticket, pickle.dumps(item)))
            except Exception as error:
                worker.alone = False
                self._result(self.stages.failed(item, f"the item cannot be sent: {_message(error)}", code_of(error)))
                continue
            worker.items[ticket] = item
            worker.wants = False
            with contextlib.suppress(OSError):  # the worker died, and its sentinel reports it
                worker.connection.send_bytes(blob)

    def _result(self, result: Any) -> None:
        self.results += 1
        self.warm = self.warm or self.results >= FIRST
        self.on_result(result)

    def _listen(self) -> None:
        """Wait a moment for messages and deaths of workers, and handle them."""
        ready = wait([thing for worker in self.workers for thing in (worker.connection, worker.process.sentinel)], TICK)
        for place, worker in enumerate(self.workers):
            dead = worker.process.sentinel in ready
            if dead or worker.connection in ready:
                self._hear(worker)
            if dead:
                self.workers[place] = self._bury(worker)
            elif self.limit is not None:
                self.workers[place] = self._end_late(worker, self.limit)

    def _hear(self, worker: _Worker) -> None:
        with contextlib.suppress(EOFError, OSError):  # the last message of a killed worker may be cut short
            while worker.connection.poll():
                kind, ticket, value = pickle.loads(worker.connection.recv_bytes())
                worker.heard = True
                if kind == "next":
                    worker.wants = True
                elif kind == "warm":
                    self.warm = True
                elif kind in ("begins", "rests"):
                    worker.clock(kind, ticket)
                else:
                    item = worker.items.pop(ticket)
                    worker.alone = False
                    try:
                        result = pickle.loads(value) if kind == "result" else self.stages.failed(item, value, 2)
                    except Exception as error:
                        result = self.stages.failed(item, f"its result cannot be read: {_message(error)}", 2)
                    self._result(result)

    def _end_late(self, worker: _Worker, limit: float) -> _Worker:
        """Kill and replace a worker if one of its items is over the time limit, and return the worker of its place.

        Its other items begin again. Killed it may be at any moment: what it leaves is swept as after any death.
        """
        late = [ticket for ticket in worker.items if worker.seconds(ticket) > limit]
        if not late:
            return worker
        worker.process.kill()
        worker.process.join()
        self._hear(worker)  # some may have ended just now
        worker.connection.close()
        for ticket, item in worker.items.items():
            if ticket in late:
                reason = f"it took longer than the time limit of {limit:g} s"
                self._result(self.stages.failed(item, reason, CheckError.exit_code))
            elif worker.alone:
                self.again.append((ticket, item))
            elif not self.interrupts.stop.is_set():
                self.back.append((ticket, item))
        return self._start(worker.number)

    def _bury(self, worker: _Worker) -> _Worker:
        """Start a worker in place of a dead one. Each of its items may be the cause, and is tried once more, alone."""
        worker.process.join()
        code = worker.process.exitcode or 0
        cause = f"was killed (signal {-code})" if code < 0 else f"ended (exit code {code})"
        worker.connection.close()
        self.stillborn = 0 if worker.heard else self.stillborn + 1
        if self.stillborn > 2:
            raise DeviceError(f"worker processes cannot start: the last one {cause} before it was ready")
        if not self.interrupts.stop.is_set():
            for ticket, item in worker.items.items():
                if worker.alone:
                    self._result(
                        self.stages.failed(item, f"two processes ended while they worked on it; the second {cause}", 2)
                    )
                else:
                    self.again.append((ticket, item))
            if not worker.alone:
                count = len(worker.items)
                again = "its item is" if count == 1 else f"its {count} items are"
                self.report(f"worker {worker.number} {cause}" + (f"; {again} tried again" if count else ""))
        return self._start(worker.number)

    def _end(self, at_once: bool) -> None:
        """End the workers: by closing their pipes, with `at_once` by SIGTERM too, and by force after a time."""
        for worker in self.workers:
            worker.connection.close()
            if at_once:
                worker.process.terminate()
        # A thread of a worker may still be inside a call of the driver.
        deadline = time.monotonic() + 2 * PATIENCE
        for worker in self.workers:
            worker.process.join(max(deadline - time.monotonic(), 0))
            if worker.process.is_alive():
                worker.process.kill()
                worker.process.join()


_environment_lock = threading.Lock()


@contextlib.contextmanager
def _environment(values: Mapping[str, str]) -> Iterator[None]:
    """Set environment variables for processes that start within the `with` block."""
    with _environment_lock:
        before = {name: os.environ.get(name) for name in values}
        os.environ.update(values)
        try:
            yield
        finally:
            for name, value in before.items():
                if value is None:
                    del os.environ[name]
                else:
                    os.environ[name] = value


# ---------------------------------------------------------------------------------------------- a Dask cluster


class _Service:
    """The pipeline of a Dask worker. Its task threads share it, and it computes in a thread of its own."""

    def __init__(self, stages: Stages) -> None:
        self._jobs: queue.SimpleQueue[tuple[int, Any]] = queue.SimpleQueue()
        self._waiting: dict[int, Future[Any]] = {}
        self._tickets = itertools.count()
        self._pipeline = Pipeline(stages, self._jobs.get, self._emit)
        threading.Thread(target=self._run, name="compute", daemon=True).start()

    def _run(self) -> None:
        error: BaseException = RuntimeError("the pipeline ended")
        try:
            self._pipeline.run()
        except BaseException as raised:
            error = raised
        with _services_lock:
            for stages in [stages for stages, service in _services.items() if service is self]:
                del _services[stages]
        for future in list(self._waiting.values()):
            future.set_exception(RuntimeError(_message(error)))

    def _emit(self, ticket: int, item: Any, result: Any) -> None:
        self._waiting.pop(ticket).set_result(result)

    def do(self, item: Any) -> Any:
        """Run an item and return its result."""
        ticket, future = next(self._tickets), Future[Any]()
        self._waiting[ticket] = future
        self._jobs.put((ticket, item))
        return future.result()


_services: dict[Stages, _Service] = {}
_services_lock = threading.Lock()


def _do(stages: Stages, item: Any, version: str) -> Any:
    """Run an item on a Dask worker, as the task that `_Call` unpickles to."""
    if version != VERSION:
        return stages.failed(
            item, f"its worker has whitefurnace {VERSION}, the batch {version}", UnsupportedError.exit_code
        )
    with _services_lock:
        if stages not in _services:
            _services[stages] = _Service(stages)
        service = _services[stages]
    result = service.do(item)
    try:
        pickle.dumps(result)
    except Exception as error:
        return stages.failed(item, f"its result cannot be sent: {_message(error)}", code_of(error))
    return result


@dataclass(frozen=True)
class _Call:
    """A call that runs when it is unpickled.

    It is sent as bytes to `pickle.loads`, because a scheduler unpickles tasks too and need not have this package.
    """

    stages: Stages
    item: Any

    def __reduce__(self) -> tuple[Any, ...]:
        return _do, (self.stages, self.item, VERSION)


def _settle(neighbours: Mapping[str, int], dask_worker: Any) -> str:
    """Limit a Dask worker to its share of the cores, before it loads OpenCL; return the version of this package there.

    neighbours: number of workers on the machine of each worker, by its address.
    """
    count = neighbours.get(dask_worker.address, 1)
    if count > 1:
        os.environ.update(core_limit(max(cores() // count, 1)))
    return VERSION


def _on_cluster(
    stages: Stages,
    items: Iterable[Any],
    address: str,
    on_result: Callable[[Any], None],
    report: Callable[[str], None],
    interrupts: _Interrupts,
) -> None:
    try:
        import distributed
    except ImportError:
        raise UnsupportedError('a scheduler needs Dask: pip install "whitefurnace[dask]"') from None
    loggers = [logging.getLogger(name) for name in ("distributed", "distributed.client")]
    levels = [logger.level for logger in loggers]
    for logger in loggers:
        logger.setLevel(logging.CRITICAL)  # a lost scheduler is reported by one sentence of ours
    try:
        _check_tls(distributed, address)
        try:
            client = distributed.Client(address, timeout=CONNECT_SECONDS, set_as_default=False)
        except (OSError, TimeoutError) as error:
            raise FileError(f"no scheduler answers at {address}") from error
        except (ValueError, TypeError) as error:
            raise UsageError(
                f"{address!r} is not the address of a scheduler, such as tcp://host:8786: {error}"
            ) from error
        cluster = _Cluster(stages, items, address, client, on_result, report, interrupts)
        try:
            cluster.run()
        except BaseException:
            with contextlib.suppress(Exception):
                client.cancel(list(cluster.flying), force=True)
            raise
        finally:
            with contextlib.suppress(Exception):
                client.close(timeout=PATIENCE)
    finally:
        for logger, level in zip(loggers, levels, strict=True):
            logger.setLevel(level)


def _check_tls(distributed: Any, address: str) -> None:
    """Raise UsageError for an encrypted address without certificates, which Dask would try until its time is up."""
    if address.partition("://")[0].lower() not in ("tls", "wss"):
        return
    settings = distributed.Security()
    try:
        given = settings.get_connection_args("client").get("ssl_context")
    except OSError as error:  # a file that is missing, or is no certificate; it does not say which
        files = (settings.tls_ca_file, settings.tls_client_cert, settings.tls_client_key)
        names = ", ".join(str(file) for file in files if file)
        raise FileError(f"a file of Dask's TLS settings cannot be read ({names}): {error}") from error
    if given is None:
        raise UsageError(
            f"{address} needs Dask's TLS settings, in its configuration or as the environment variables "
            "DASK_DISTRIBUTED__COMM__TLS__CA_FILE, DASK_DISTRIBUTED__COMM__TLS__CLIENT__CERT and "
            "DASK_DISTRIBUTED__COMM__TLS__CLIENT__KEY"
        )


class _Cluster:
    """A run on a Dask cluster. At most WINDOW items for each worker are submitted at a time."""

    def __init__(
        self,
        stages: Stages,
        items: Iterable[Any],
        address: str,
        client: Any,
        on_result: Callable[[Any], None],
        report: Callable[[str], None],
        interrupts: _Interrupts,
    ) -> None:
        self.stages = stages
        self.source = enumerate(items)
        self.address = address
        self.client = client
        self.on_result = on_result
        self.report = report
        self.interrupts = interrupts
        self.flying: dict[Any, Any] = {}  # future -> item
        self.landed: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.settled: set[str] = set()
        self.done = 0
        self.window = 0
        self.looked = -1e9
        self.lonely = False

    def run(self) -> None:
        ended, failure = False, None
        while True:
            stopping = self.interrupts.look()
            if not stopping and not ended:
                self._look()
            while not stopping and not ended and len(self.flying) < self.window:
                try:
                    job = next(self.source, None)
                except Exception as error:
                    job, failure = None, error
                if job is None:
                    ended = True
                else:
                    self._submit(job[1])
            if not self.flying and (stopping or ended):
                break
            self._land()
        if failure is not None:
            raise failure

    def _gone(self) -> FileError:
        """Return the error for a lost scheduler."""
        done = "1 item was" if self.done == 1 else f"{self.done} items were"
        return FileError(f"the scheduler at {self.address} was lost after {done} done; run the batch again to continue")

    def _look(self) -> None:
        """Every two seconds, look which workers there are, and limit new ones to their share of the cores."""
        now = time.monotonic()
        if now - self.looked < 2:
            return
        if self.client.status != "running":
            raise self._gone()
        self.looked = now
        try:
            workers = self.client.scheduler_info(n_workers=-1)["workers"]
        except Exception as error:
            raise self._gone() from error
        able = {name: facts["host"] for name, facts in workers.items() if facts["resources"].get(RESOURCE, 0) >= SHARE}
        if not able and not self.lonely:
            self.lonely = True
            self.report(
                f"waiting: no worker at {self.address} declares {RESOURCE}=1 "
                f"(dask worker {self.address} --nthreads 4 --resources {RESOURCE}=1)"
            )
        fresh = [name for name in able if name not in self.settled]
        if fresh:
            hosts = list(able.values())
            versions = self.client.run(
                _settle, {name: hosts.count(host) for name, host in able.items()}, workers=fresh, on_error="return"
            )
            for name, version in versions.items():
                if isinstance(version, ImportError):
                    raise UnsupportedError(
                        f"the worker {name} has no whitefurnace {VERSION}: install it there ({_message(version)})"
                    )
                if isinstance(version, str) and version != VERSION:
                    raise UnsupportedError(
                        f"the worker {name} has whitefurnace {version} and this machine {VERSION}: "
                        "install one version on both"
                    )
            self.settled.update(fresh)
        self.window = WINDOW * len(able)

    def _submit(self, item: Any) -> None:
        try:
            sent = self.stages.load(item) if self.stages.load is not None else item
            call = pickle.dumps(_Call(self.stages, sent))
            future = self.client.submit(pickle.loads, call, pure=False, resources={RESOURCE: SHARE})
        except Exception as error:
            if self.client.status != "running":
                raise self._gone() from error
            self._result(self.stages.failed(item, f"the item cannot be sent: {_message(error)}", code_of(error)))
            return
        self.flying[future] = item
        future.add_done_callback(self.landed.put)

    def _result(self, result: Any) -> None:
        self.done += 1
        self.on_result(result)

    def _land(self) -> None:
        """Wait a moment for results, and handle all that have arrived."""
        landed = []
        with contextlib.suppress(queue.Empty):
            landed.append(self.landed.get(timeout=TICK))
            while True:
                landed.append(self.landed.get_nowait())
        if self.client.status != "running" or any(future.status in ("cancelled", "lost") for future in landed):
            raise self._gone()
        whole = [future for future in landed if future.status == "finished"]
        try:
            values = dict(zip(whole, self.client.gather(whole), strict=True)) if whole else {}
        except Exception as error:
            if self.client.status != "running":
                raise self._gone() from error
            values = {}
        for future in landed:
            item = self.flying.pop(future)
            if future in values:
                result = values[future]
            else:
                result = self.stages.failed(item, _why(future), 2)
            future.release()
            self._result(result)


def _why(future: Any) -> str:
    """Return the reason why a task has no result, in one line."""
    try:
        error = future.exception(timeout=PATIENCE)
    except Exception as unreadable:
        error = unreadable
    if type(error).__name__ == "KilledWorker":  # after the scheduler's distributed.scheduler.allowed-failures
        return "every worker that had it was killed"
    return _message(error) if error is not None else "its result cannot be read"
