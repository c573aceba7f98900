"""FeUdal Networks (Vezhnevets et al. 2017), for continuous actions: the method that the paper compares with."""
