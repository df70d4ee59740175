"""`roboneuron doctor`: is this machine ready? Every check is data (id, question) and answers with
one finding.
"""
