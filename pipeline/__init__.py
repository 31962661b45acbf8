"""The library the stages are made of: geometry, geodesy, sources, matching, fusion, scoring. Never imports stages."""
