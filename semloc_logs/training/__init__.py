"""Learning the descriptor and its words, from simulated scenes or from sessions of one's own (paper
3.2, supplement 1).
"""
