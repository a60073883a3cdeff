"""`adp recover`: a whole bag from a torn one."""

from pathlib import Path as FilePath

import click

from adp_path_follower.bags.recovery.recover import Recovery
from adp_path_follower.bags.recovery.recover import recover as recover_bag
from adp_path_follower.cli import options


@click.command()
@click.argument("bag", type=options.FILE)
@options.file_option("--out", "output", "The new bag; BAG_recovered by default.", "DIR")
def recover(bag: FilePath, output: FilePath | None) -> None:
    r"""Save what can be read of a torn recording into a new bag.

    BAG is the directory of a rosbag2 bag (MCAP), or one .mcap file: cut off when a process or the
    machine died, or damaged in the middle. It is not changed. The new bag has the same messages,
    times and types, and is whole: with index, statistics and metadata.yaml.

    \b
    After a kill -9:
        adp recover adp_run_2025_01_31-12_00_00
    """
    with options.progress_bar(f"recovering {bag}") as progress:
        recovery = recover_bag(bag, output, progress)
    click.echo(_report(recovery))


def _report(recovery: Recovery) -> str:
    counts = recovery.message_counts
    lines = [f"saved {sum(counts.values())} messages to {recovery.bag}"]
    lines += [f"{count:10d}  {topic}" for topic, count in sorted(counts.items())]
    if recovery.bytes_left:
        lines.append(
            f"left {recovery.bytes_left} of {recovery.bytes_read} bytes that could not be read"
        )
    else:
        lines.append("nothing was unreadable")
    return "\n".join(lines)
