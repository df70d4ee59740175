"""`roboneuron doctor`: checks whether this machine is ready. Each check is data (id, question) with
one finding as its answer.
"""
