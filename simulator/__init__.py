"""A stand-in for Udacity's driving simulator: the same roads, car, cameras, recordings and wire, without a screen.

The modules in the order of the data: scenery, world, car, cameras, then record or client, then report.
`python -m simulator --help` lists its commands.
"""
