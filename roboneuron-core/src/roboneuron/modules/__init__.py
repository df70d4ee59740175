"""The managed nodes of the data plane, one process each: perception, inference, control, robot.

`python -m roboneuron.modules` reads one line of JSON (`ModuleSettings`) from stdin and runs that
module until it is stopped or stdin ends, which means that its parent has ended.
"""
