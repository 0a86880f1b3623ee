"""Scene priors: trained denoisers that sample, complete and rearrange scenes."""
