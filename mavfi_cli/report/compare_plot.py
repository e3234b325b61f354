"""stub"""
def write_compare_plot(a,b): pass
