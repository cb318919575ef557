from snakemake.utils import min_version

min_version("9.27")


configfile: "config/config.yaml"


include: "rules/engine.smk"
include: "rules/common.smk"
include: "rules/demo.smk"
include: "rules/ingest.smk"
include: "rules/align.smk"
include: "rules/sfm.smk"
include: "rules/frames.smk"
include: "rules/views.smk"
include: "rules/stereo.smk"
include: "rules/silhouettes.smk"
include: "rules/fuse.smk"
include: "rules/background.smk"
include: "rules/composition.smk"
include: "rules/render.smk"
include: "rules/edit.smk"
include: "rules/evaluate.smk"
include: "rules/plan.smk"
include: "rules/report.smk"
include: "rules/viewer.smk"
include: "rules/export.smk"
include: "rules/bench.smk"
include: "rules/ablations.smk"


rule render_all:
    default_target: True
    input:
        FILMS,
        EVALUATION,
    localrule: True


onstart:
    check_folders()
    check_budget(rule.name for rule in workflow.dag.targetrules)
    calm_engine()


onsuccess:
    print_finished()
