"""What the study found: rank correlations of each measure with driving, tables and pictures."""

from collections.abc import Sequence

import numpy as np
from matplotlib.figure import Figure

from cloning.base.figure import png
from cloning.road.motion import MPH
from tools import command
from tools.study.measures import RECOVERY_SECONDS, RECOVERY_SPEED
from tools.study.networks import RECOVERING, TRACKS, Variant

Row = dict[str, float | str]  # a network: the columns of `row`

RESAMPLES = 2000  # of the bootstrap
INTERVAL = 2.5, 97.5  # percentiles: 95 %
DPI = 150


# What might tell how a network drives: columns of study.csv, each with its title, and 1 if more is worse, -1 if better.
LOSSES = {  # errors on recorded frames, of which a loss is made
    "own_val_loss": ("its own validation loss", 1),
    "mse": ("mean squared error", 1),
    "mae": ("mean absolute error", 1),
    "correlation": ("correlation with the driver", -1),
    "large_errors": ("share of errors above 0.2", 1),
    "whiteness": ("whiteness of the steering", 1),
}
REPLAYS = {
    "drift": ("replay of 2 s: drift from the driver", 1),
    "autonomy_1": ("replay: autonomy at 1 m", -1),
    "autonomy_2.5": ("replay: autonomy at 2.5 m", -1),
    "metres_per_intervention_1": ("replay: m per intervention at 1 m", -1),
    "replay_distance_2.5": ("replay: mean distance", 1),
}
MEASURES = LOSSES | REPLAYS
INTRODUCTION = """Made by `python -m tools.study`. How, and what follows from it, is in [the
report](../../writeup_report.md#does-the-loss-tell-how-it-drives). Each network's errors are those against the human
driver on the recording of its track that it did not see, its replays are of that recording, and its laps are driven in
the stand-in simulator. *mse*: mean squared error; *whiteness*: root mean square of the steering's change per second;
*drift*: how far from the driver's path the car is after 2 s. [study.csv](study.csv) has a row for each network,
which is named by its recipe, or by what differs from the report's: *centre camera*, no images of the side cameras;
*shifts* and *rotations*, images seen from beside the lane's centre, or turned."""
SIGNED = """Spearman's, signed so that 1 is perfect foresight; in brackets, 95 % of a bootstrap's draws. Laps are the
worse, the more departures per km they have, and among equals the further they are from the lane's centre."""
EQUALS = 0.01  # departures per km that a metre of mean distance counts: less than one departure in a lap
COLOURS = dict.fromkeys(LOSSES, "tab:orange") | dict.fromkeys(REPLAYS, "tab:blue")


def row(variant: Variant, found: dict[str, float]) -> Row:
    """Return a network's row of study.csv; found: its measures."""
    about: Row = {"track": variant.track, "method": variant.method, "recipe": variant.recipe.name}
    about |= {"seed": variant.seed, "recordings": " ".join(variant.recordings)}
    return {**about, "recovered": "", **found}


def column(rows: Sequence[Row], name: str) -> np.ndarray:
    """Return a column of numbers: float64 (n,)."""
    return np.array([float(each[name]) for each in rows])


def driving(rows: Sequence[Row]) -> np.ndarray:
    """Return how badly networks drive in the laps, by departures and, among equals, by mean distance: float64 (n,)."""
    return column(rows, "departures_per_km") + EQUALS * column(rows, "offset_mean")


def correlated(measure: np.ndarray, driving: np.ndarray, sign: int) -> tuple[float, float, float]:
    """Return Spearman's rank correlation of a measure with driving, and the ends of its 95 % interval.

    measure, driving: float64 (n,); sign: see LOSSES; more driving is worse. The interval is that of a bootstrap over
    the networks. nan if either has the same value everywhere.
    """
    from scipy.stats import rankdata  # large, and only a report needs it

    rng, n = np.random.default_rng(0), len(measure)
    draws = np.vstack([np.arange(n), rng.integers(n, size=(RESAMPLES, n))])
    ranks = [rankdata(values[draws], axis=1) - (n + 1) / 2 for values in (measure, driving)]  # centred: n ranks
    products, squares = (ranks[0] * ranks[1]).sum(axis=1), [(rank**2).sum(axis=1) for rank in ranks]
    with np.errstate(invalid="ignore"):
        values = sign * products / np.sqrt(squares[0] * squares[1])
    if np.isnan(values[0]):
        return (float("nan"),) * 3
    low, high = np.nanpercentile(values[1:], INTERVAL)
    return float(values[0]), float(low), float(high)


def groups(rows: Sequence[Row]) -> dict[str, list[Row]]:
    """Return the groups in which networks are compared, by title: each track's, and those without --robust of each.

    The labels of --robust are not the driver's steering, which the losses are measured by here; so the groups without
    it show what a loss tells of networks that all learned that.
    """
    found = {track: [each for each in rows if each["track"] == track] for track in TRACKS}
    for track in TRACKS:
        found[f"{track}, without --robust"] = [row for row in found[track] if row["recipe"] != "robust"]
    return found


def correlations(rows: Sequence[Row]) -> dict[str, tuple[float, float, float]]:
    """Return, by measure, the correlation of some networks with driving, and its interval."""
    true = driving(rows)
    return {name: correlated(column(rows, name), true, sign) for name, (_, sign) in MEASURES.items()}


def report(rows: Sequence[Row]) -> str:
    """Return study.md: the correlations on each track, and the recovery."""
    lines = ["# Does the loss tell how a network drives?", "", INTRODUCTION]
    compared = {title: part for title, part in groups(rows).items() if len(part) > 2}
    lines += ["", "## Rank correlation with laps in the stand-in simulator", ""]
    lines.append(command.head("measure", *(f"{title}, {len(part)} networks" for title, part in compared.items())))
    found = [correlations(part) for part in compared.values()]
    for measure, (title, _) in MEASURES.items():
        lines.append(command.row(title, *("{:.2f} ({:.2f} to {:.2f})".format(*each[measure]) for each in found)))
    lines += ["", SIGNED]
    seconds, metres = RECOVERY_SECONDS, RECOVERY_SPEED * MPH
    lines += ["", f"## Back in the lane within {seconds:g} s, at {metres:.0f} m/s", ""]
    lines.append(command.head("trained with", "of its starts, by seed", "mean"))
    for method, shares in recovery(rows).items():
        by_seed = ", ".join(f"{100 * share:.0f} %" for share in shares)
        lines.append(command.row(method, by_seed, f"{100 * np.mean(shares):.0f} %"))
    return "\n".join(lines) + "\n"


def recovery(rows: Sequence[Row]) -> dict[str, list[float]]:
    """Return the shares recovered by method, in the order of the plan."""
    measured = [row for row in rows if row["recovered"] != ""]
    found = {name: [float(row["recovered"]) for row in measured if row["method"] == name] for name in RECOVERING}
    return {method: shares for method, shares in found.items() if shares}


def correlation_picture(rows: Sequence[Row]) -> bytes:
    """Return bars of each measure's correlation with driving, by group; the title counts intervals above 0."""
    compared, figure = groups(rows), Figure((12, 4.9), layout="constrained")
    foretelling = dict.fromkeys(MEASURES, 0)
    every_axes = figure.subplots(1, len(compared), sharey=True)
    for axes, (title, part) in zip(every_axes, compared.items(), strict=True):
        found = correlations(part) if len(part) > 2 else {}
        for at, measure in enumerate(MEASURES):
            value, low, high = found.get(measure, (np.nan,) * 3)
            foretelling[measure] += low > 0
            axes.barh(at, value, color=COLOURS[measure], alpha=0.8, height=0.7)
            axes.plot([low, high], [at, at], color="black", linewidth=1.2)
        axes.axvline(0, color="black", linewidth=0.8)
        axes.set(xlim=(-1, 1), title=f"{title}\n{len(part)} networks")
        axes.grid(axis="x", alpha=0.3)
    every_axes[0].set_yticks(range(len(MEASURES)), [title for title, _ in MEASURES.values()])
    every_axes[0].invert_yaxis()
    figure.suptitle(
        f"The drift in a replay foretells how networks drive in {foretelling['drift']} of {len(compared)} groups, "
        f"the mean squared error in {foretelling['mse']}"
    )
    figure.supxlabel("rank correlation with driving: 1 is perfect foresight")
    return png(figure, DPI)
