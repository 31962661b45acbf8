"""The synthetic site and flight behind `epitransfer example`: geometry, pictures, tags, tiles and the truth."""
