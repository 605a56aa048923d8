#!/usr/bin/env python3
"""How many instructions a frame takes on 64-bit ARM, by what they are for, counted where no ARM is at hand.

    python3 docs/measurements/scripts/instructions.py --slabcast target/aarch64-unknown-linux-gnu/release/slabcast -- VOLUME [flags of bench]

Runs `slabcast lab bench` on one thread in qemu's emulator of one program (7.2, whose plugins it was written for), which notes
how often each piece of code ran, asks llvm-symbolizer which functions and files each instruction came from, those
inlined included, and adds them up by stage. Numbers of instructions are no times: a load that misses the cache, a
division and an addition count alike. Needs cc, too, for the plugin, which stands below.
"""

import argparse
import collections
import json
import os
import pathlib
import re
import subprocess
import tempfile

# Of qemu's interface for plugins, what is needed here: its header is in no package.
PLUGIN = r"""
#include <inttypes.h>
#include <stddef.h>
#include <stdio.h>
#include <stdlib.h>
struct qemu_plugin_tb;
void qemu_plugin_register_vcpu_tb_trans_cb(uint64_t, void (*)(uint64_t, struct qemu_plugin_tb *));
void qemu_plugin_register_vcpu_tb_exec_inline(struct qemu_plugin_tb *, int add, void *, uint64_t);
void qemu_plugin_register_atexit_cb(uint64_t, void (*)(uint64_t, void *), void *);
size_t qemu_plugin_tb_n_insns(const struct qemu_plugin_tb *);
uint64_t qemu_plugin_tb_vaddr(const struct qemu_plugin_tb *);

int qemu_plugin_version = 1;
static struct block { uint64_t from, size, runs; struct block *next; } *all;

/* Called under a lock, once for each translation; blocks may be translated again. */
static void translated(uint64_t id, struct qemu_plugin_tb *tb) {
    struct block *block = calloc(1, sizeof *block);
    if (!block) abort();
    block->from = qemu_plugin_tb_vaddr(tb);
    block->size = qemu_plugin_tb_n_insns(tb);
    block->next = all;
    all = block;
    qemu_plugin_register_vcpu_tb_exec_inline(tb, 0, &block->runs, 1);
}

static void end(uint64_t id, void *nothing) {
    FILE *to = fopen(getenv("BLOCKS"), "w");
    if (!to) abort();
    for (struct block *b = all; b; b = b->next)
        fprintf(to, "%" PRIx64 " %" PRIu64 " %" PRIu64 "\n", b->from, b->size, b->runs);
    fclose(to);
}

int qemu_plugin_install(uint64_t id, const void *info, int n, char **arguments) {
    qemu_plugin_register_vcpu_tb_trans_cb(id, translated);
    qemu_plugin_register_atexit_cb(id, end, NULL);
    return 0;
}
"""

# Where qemu loads a program that may lie anywhere.
BASE = 0x5500000000
# Stages by file and function of the outermost caller that has any; what else draws is `other`.
STAGES = [
    ("toss", r"kernels/toss\.rs$", r""),
    ("list", r"kernels/touched\.rs$", r"list"),
    ("empty", r"kernels/touched\.rs$", r"sift"),
    ("take", r"kernels/touched\.rs$", r"take"),
    ("put", r"kernels/touched\.rs$", r"^(put|fours)$"),
    ("close", r"kernels/composite/rows\.rs$", r""),
    ("splat", r"kernels/pixel_records\.rs$", r""),
]


def blocks(slabcast, scene):
    """What bench says, and how often each instruction of the program ran."""
    with tempfile.TemporaryDirectory() as folder:
        plugin, out = f"{folder}/count.so", f"{folder}/blocks"
        subprocess.run(["cc", "-O2", "-shared", "-fPIC", "-x", "c", "-", "-o", plugin], input=PLUGIN, text=True, check=True)
        bench = subprocess.run(
            ["qemu-aarch64", "-L", "/usr/aarch64-linux-gnu", "-plugin", plugin, slabcast, "lab", "bench", *scene, "--threads", "1",
             "--pixels", "0", "--json"], check=True, capture_output=True, text=True, env={**os.environ, "BLOCKS": out}).stdout
        runs = collections.Counter()
        for line in open(out):
            begin, size, n = line.split()
            for i in range(int(size)):
                runs[int(begin, 16) - BASE + 4 * i] += int(n)
    return json.loads(bench), {at: n for at, n in runs.items() if n and 0 <= at < 1 << 28}


def stage(chain):
    """Of functions and their files, the innermost first."""
    for function, at in reversed(chain):
        name = re.sub(r"::h[0-9a-f]{16}.*$", "", function).split("<")[0].split("::")[-1]
        for stage, file, functions in STAGES:
            if re.search(file, at.split(":")[0]) and re.search(functions, name):
                return stage
    return "other" if any("/worker/render/" in at for _, at in chain) else None


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--slabcast", required=True, type=pathlib.Path)
    parser.add_argument("scene", nargs="+")
    args = parser.parse_args()
    exe = str(args.slabcast.resolve())
    bench, runs = blocks(exe, args.scene)
    text = subprocess.run(["llvm-symbolizer", f"--obj={exe}", "--inlines"], check=True, text=True,
                          input="\n".join(map(hex, runs)), capture_output=True).stdout
    stages = collections.Counter()
    for (at, n), chain in zip(runs.items(), text.strip().split("\n\n"), strict=True):
        lines = chain.split("\n")
        stages[stage(list(zip(lines[::2], lines[1::2])))] += n
    frames = len(bench["each_ms"])
    print(f"{bench['simd']}, {bench['quality']['sums']} sums; millions of instructions a frame, of {frames}")
    for name in [*(s for s, *_ in STAGES), "other"]:
        print(f"{name:8} {stages[name] / frames / 1e6:8.1f}")
    del stages[None]
    print(f"{'all':8} {sum(stages.values()) / frames / 1e6:8.1f}")


if __name__ == "__main__":
    main()
