"""A stand-in for Udacity's driving simulator: the same roads, car, cameras, recordings and protocol, without a screen.

The modules in the order of the data: scenery, world, car, run, cameras; then record, or client, film and report.
`expert` drives recordings; `window` and `controls` let a person drive, `environment` a program, `join` other people's.
`python -m simulator --help` lists the commands.
"""
