"""One page about the scene: `snakemake report_all`, and part of `snakemake --report`."""

import os
import shlex

# Jobs are started by a command of the engine; the page shows the one that a person gave.
os.environ.setdefault("FOURD_COMMAND", shlex.join(["snakemake", *sys.argv[1:]]))


rule report_page:
    input:
        EVALUATION,
        FILMS,
        truth=config["report"]["truth"] or [],
        cameras="<results>/<scene>/sfm/cameras.json",
    output:
        page=report(
            "<results>/<scene>/report/index.html",
            category="Scene",
            labels={"scene": SCENE.name, "what": "One page about the scene"},
        ),
        document="<results>/<scene>/report/report.json",
        tables=multiext("<results>/<scene>/report/", "scores.csv", "costs.csv", "error_time.csv"),
    log:
        "<logs>/<scene>/report_page.log",
    benchmark:
        "<benchmarks>/<scene>/report_page.tsv"
    conda:
        "../envs/vision.yaml"
    threads: 1
    params:
        benchmarks=f"{config['pathvars'].get('benchmarks', 'benchmarks')}/{SCENE.name}",
        # Shown if they are there: the page does not wait for suites that take longer than the run.
        stability=f"{Path(RESULTS).parent}/stability/stability.csv",
        benches=f"{Path(RESULTS).parent}/bench",
        settings=flags_from_mapping({"settings": json.dumps(config, sort_keys=True)}),
        options=options("report"),
        # What else lies there is of an earlier scene.
        current=flags_from_mapping({"num_levels": len(LEVELS), "edits": list(EDITS)}),
        version=fourd_config.stage_version("report"),
    shell:
        "python -m fourd.report --results $(dirname $(dirname {input.cameras})) --benchmarks {params.benchmarks}"
        " --stability {params.stability} --benches {params.benches} {params.settings}"
        " {params.options} {params.current} --output $(dirname {output.page}) 2> {log}"


rule report_all:
    input:
        "<results>/<scene>/report/index.html",
    localrule: True
