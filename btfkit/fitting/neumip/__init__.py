"""NeuMIP while it is fitted: recipes, data, and the engines that take their steps."""
