"""The loop closed all the way: fly, name what the model lacks, train on the corrected model, fly the same drone again.

The drone is a labelled plant (`cfb_mjx.labelled_plants`), a simulator that shares nothing with the library's model.
"""
