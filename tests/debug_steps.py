"""Some steps of an environment with checked reads and writes: ``python -m tests.debug_steps FOLDER NAME [WORLDS ...]``.

In Warp's debug mode a CPU checks the indices of all arrays, and ends the process at the first that is out of bounds: so
it finds what a GPU would only crash on by chance. Kernels of that mode go to a folder of their own. Without a NAME a
kernel reads past the end of an array, to show that this is found.
"""

import sys

import warp as wp

STEPS = 3


@wp.kernel
def read_past_the_end(a: wp.array(dtype=float), b: wp.array(dtype=float)):  # type: ignore[valid-type, no-untyped-def]
    """Reads an entry that is not there."""
    i = wp.tid()
    b[i] = a[i + 1]


def main(folder: str, name: str | None = None, *worlds: str) -> None:
    """Steps of an environment with each number of worlds, with a reset of some in between."""
    wp.config.mode, wp.config.kernel_cache_dir = "debug", folder
    if name is None:
        a, b = (wp.zeros(4, dtype=float, device="cpu") for _ in range(2))
        wp.launch(read_past_the_end, 4, [a, b], device="cpu")
        return
    import torch

    import softwarp as sw
    from tests.env_cases import FAST

    for count in (int(told) for told in worlds):
        env = sw.make(name, num_worlds=count, seed=0, **FAST.get(name, {}))
        data = env.reset()
        for step in range(STEPS):
            data = env.rand_step(data)
            if step == 1:
                some = torch.zeros((count, 1), dtype=torch.bool)
                some[0] = True
                env.reset(data["next"].exclude("reward").set("_reset", some))
        sys.stdout.write(f"{name} with {count} worlds: fine\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main(*sys.argv[1:])
