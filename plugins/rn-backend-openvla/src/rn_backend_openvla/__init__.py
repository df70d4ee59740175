"""OpenVLA behind the fixed action contract.

Public for other packages of the family: `checkpoint`, `layout`, `vision`, `front`, `preprocessing`, `prompt`,
`statistics`, `profiles`, `bins`, `policy` and `tiny`.
"""
