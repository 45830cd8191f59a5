"""Logs of the interactive training strategy that tests read."""

LOG = """\
epoch,level,phase,n_instances,objective,seconds,generation_seconds
1,router,pre-training,100,9.5,6.0,0.0
1,allocator,alternate,100,30.0,12.0,0.0
2,router,alternate,100,8.0,5.0,1.0
2,allocator,alternate,100,31.0,18.0,0.0
3,router,alternate,50,8.0,6.0,2.0
"""
