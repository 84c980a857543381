"""The filters: plain functions of numbers, to use with or without an environment.

``modes.Mode`` says what runs, ``pipeline.consider`` and ``pipeline.commit`` run it for one
epoch, ``imm`` weighs several modes, ``smoother`` looks back over a finished track.
"""
