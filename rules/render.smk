"""Films: generators applied frame by frame, then one video per trajectory."""


rule render_frames:
    input:
        view="<results>/{scene}/views/{view}.json",
        models=expand("<results>/{{scene}}/composition/{level}/model.pt", level=LEVELS),
        foreground="<results>/{scene}/foreground/{view}/{chunk}.npz",
        background="<results>/{scene}/background/{view}/{chunk}.npz",
    output:
        directory("<results>/{scene}/render/{view}/{chunk}"),
    log:
        "<logs>/{scene}/render_frames/{view}/{chunk}.log",
    benchmark:
        "<benchmarks>/{scene}/render_frames/{view}/{chunk}.tsv"
    priority: 20
    conda:
        "../envs/torch.yaml"
    threads: 1
    resources:
        gpu=1,
    params:
        frames=lambda wildcards: frames_of_view(wildcards.view, wildcards.chunk),
        options=options("render"),
        version=fourd_config.stage_version("render"),
    shell:
        "python -m fourd.render frames --view-file {input.view} --models {input.models}"
        " --foreground {input.foreground} --background {input.background}"
        " --frames {params.frames} {params.options} --threads {threads} --output {output} 2> {log}"


rule encode_film:
    input:
        lambda wildcards: expand(
            "<results>/{scene}/render/{view}/{chunk}",
            scene=wildcards.scene,
            view=wildcards.trajectory,
            chunk=chunks_of_view(wildcards.trajectory),
        ),
    output:
        "<results>/{scene}/render/{trajectory}.mp4",
    log:
        "<logs>/{scene}/encode_film/{trajectory}.log",
    benchmark:
        "<benchmarks>/{scene}/encode_film/{trajectory}.tsv"
    conda:
        "../envs/torch.yaml"
    threads: 1
    params:
        fps=SCENE.fps,
        options=options("render"),
        version=fourd_config.stage_version("render"),
    shell:
        "python -m fourd.render video --frames-dir {input} --fps {params.fps} {params.options}"
        " --output {output} 2> {log}"
