"""Kim et al. (2019): reproduced, corrected, and charted."""
