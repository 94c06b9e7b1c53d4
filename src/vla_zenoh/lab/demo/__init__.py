"""What a demo asks for, how it is judged, and the run folder it leaves. Pure but for the files.

    segments    which prompts, and what each asks for
    analysis    asked against reached, drift, latencies
    tables      CSV files and the chunk file
    plot        one picture of the run
    video       the front camera as an MP4

The sequence of puts is `vla_zenoh.lab.demo.runner`.
"""
