"""The loop closed all the way: fly, name what the model lacks, train on the corrected model, fly the same drone again.

It flies in the reference simulator (`cfb_mjx.reference_simulator`), which shares nothing with the library's model.
"""
