"""Simulate how a suite of thousands of recordings runs on a cluster: duration, CPU hours, repetitions, price.

    python tools/bench_schedule.py [--sequences 10000] [--minutes 3] [--rate 20] [--cpu-ms 40] [--sigma 0.8]
        [--machines 10] [--cores 64] [--losses-per-hour 0.05] [--order listed|longest] [--runs 20] [--json]

Lengths are log-normal with the given mean and sigma of the logarithm: with 0.8, one recording in a hundred is over six
times as long as the median. A task takes its frames times the CPU time of a frame, and a second to start. Machines are
lost at random times with all their tasks, which are then repeated from their beginning elsewhere, and come back after
five minutes. What `vio bench` does between tasks (keys, results of some 100 kB) is below a thousandth, and left out.
"""

from __future__ import annotations

import argparse
import heapq
import json
import sys
from collections import deque
from dataclasses import dataclass, fields

import numpy as np
import numpy.typing as npt

_START_S = 1.0  # CPU time to import the program
_BACK_S = 300.0  # until a lost machine is replaced
_PRICE_PER_CORE_HOUR = (0.01, 0.05)  # interruptible to on demand, US dollars, general-purpose machines


@dataclass(frozen=True, slots=True)
class Schedule:
    """How a suite ran."""

    sequences: int
    cores: int
    hours: float  # from the first task to the last result
    cpu_hours: float  # of the tasks, repetitions included
    repeated_cpu_hours: float  # lost with machines
    repeated_tasks: int
    busy: float  # share of the cores' time in use
    longest_task_s: float
    price_low: float  # of all cores over the whole time, US dollars
    price_high: float


def durations_s(
    sequences: int, mean_s: float, rate_hz: float, cpu_ms: float, sigma: float, seed: int
) -> npt.NDArray[np.float64]:
    """CPU time (N,) of each task, for lengths that are log-normal with this mean."""
    rng = np.random.default_rng(seed)
    lengths_s = rng.lognormal(np.log(mean_s) - sigma**2 / 2, sigma, sequences)
    return _START_S + lengths_s * rate_hz * cpu_ms * 1e-3


def simulate(
    tasks_s: npt.NDArray[np.float64],
    *,
    machines: int,
    cores: int,
    losses_per_hour: float,
    longest_first: bool,
    seed: int,
) -> Schedule:
    """Run tasks on machines of some cores each, as the workers of a scheduler do: a free core takes the next task.

    Args:
        tasks_s: (N,) CPU time of each task.
        machines: how many.
        cores: of each machine.
        losses_per_hour: expected losses of one machine in an hour.
        longest_first: order of the tasks; else as they are listed.
        seed: of the times of the losses.
    """
    rng = np.random.default_rng(seed)
    waiting = deque((np.argsort(-tasks_s, kind="stable") if longest_first else np.arange(len(tasks_s))).tolist())
    events: list[tuple[float, int, str, int, int]] = []  # time, order, kind, machine, life of the machine
    running: list[dict[int, float]] = [{} for _ in range(machines)]  # by machine: task and when it began
    life, up = [0] * machines, [True] * machines
    state = {"now": 0.0, "count": 0, "busy": 0.0, "lost": 0.0, "repeated": 0, "done": 0, "last": 0.0}

    def push(delay_s: float, kind: str, machine: int, task: int) -> None:
        state["count"] += 1
        heapq.heappush(events, (state["now"] + delay_s, int(state["count"]), kind, machine, task))

    def fill(machine: int) -> None:
        while up[machine] and waiting and len(running[machine]) < cores:
            task = waiting.popleft()
            running[machine][task] = state["now"]
            push(float(tasks_s[task]), f"done {life[machine]}", machine, task)

    def plan_loss(machine: int) -> None:
        if losses_per_hour > 0:
            push(float(rng.exponential(3600 / losses_per_hour)), f"lost {life[machine]}", machine, -1)

    for machine in range(machines):
        plan_loss(machine)
        fill(machine)
    while state["done"] < len(tasks_s):
        state["now"], _, kind, machine, task = heapq.heappop(events)
        what, _, of_life = kind.partition(" ")
        if what == "back":
            up[machine] = True
            plan_loss(machine)
        elif int(of_life) != life[machine]:
            continue
        elif what == "done":
            state["busy"] += state["now"] - running[machine].pop(task)
            state["done"] += 1
            state["last"] = state["now"]
        else:
            for lost, began in running[machine].items():
                state["busy"] += state["now"] - began
                state["lost"] += state["now"] - began
                state["repeated"] += 1
                waiting.appendleft(lost)
            running[machine].clear()
            up[machine], life[machine] = False, life[machine] + 1
            push(_BACK_S, "back", machine, -1)
        for other in range(machines):
            if waiting and len(running[other]) < cores:
                fill(other)
    return _summary(tasks_s, state, machines * cores)


def _summary(tasks_s: npt.NDArray[np.float64], state: dict[str, float], cores: int) -> Schedule:
    hours = state["last"] / 3600
    low, high = (price * cores * hours for price in _PRICE_PER_CORE_HOUR)
    return Schedule(
        sequences=len(tasks_s),
        cores=cores,
        hours=hours,
        cpu_hours=state["busy"] / 3600,
        repeated_cpu_hours=state["lost"] / 3600,
        repeated_tasks=int(state["repeated"]),
        busy=state["busy"] / (cores * state["last"]),
        longest_task_s=float(tasks_s.max()),
        price_low=low,
        price_high=high,
    )


def main() -> int:
    """Print the mean of some schedules."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequences", type=int, default=10_000)
    parser.add_argument("--minutes", type=float, default=3.0)
    parser.add_argument("--rate", type=float, default=20.0)
    parser.add_argument("--cpu-ms", type=float, default=40.0)
    parser.add_argument("--sigma", type=float, default=0.8)
    parser.add_argument("--machines", type=int, default=10)
    parser.add_argument("--cores", type=int, default=64)
    parser.add_argument("--losses-per-hour", type=float, default=0.05)
    parser.add_argument("--order", choices=("listed", "longest"), default="longest")
    parser.add_argument("--runs", type=int, default=20, help="simulations, with other lengths and losses each")
    parser.add_argument("--json", action="store_true")
    args = parser.parse_args()
    runs = [
        simulate(
            durations_s(args.sequences, 60 * args.minutes, args.rate, args.cpu_ms, args.sigma, seed),
            machines=args.machines,
            cores=args.cores,
            losses_per_hour=args.losses_per_hour,
            longest_first=args.order == "longest",
            seed=seed,
        )
        for seed in range(args.runs)
    ]
    means = {f.name: float(np.mean([getattr(run, f.name) for run in runs])) for f in fields(Schedule)}
    worst_hours = max(run.hours for run in runs)
    if args.json:
        print(json.dumps({**means, "worst_hours": worst_hours}))
        return 0
    found = Schedule(**{**means, "sequences": args.sequences, "cores": args.machines * args.cores})
    print(
        f"{found.sequences} sequences on {found.cores} cores: {found.hours:.2f} h (at worst {worst_hours:.2f}), "
        f"{found.cpu_hours:.0f} CPU hours ({found.repeated_cpu_hours:.1f} repeated, {found.repeated_tasks:.0f} tasks), "
        f"busy {100 * found.busy:.0f} %, longest task {found.longest_task_s / 60:.0f} min, "
        f"{found.price_low:.0f} to {found.price_high:.0f} USD"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
