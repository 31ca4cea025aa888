"""From images to correspondences to poses (IV-A, IV-B, IV-D, IV-F)."""
