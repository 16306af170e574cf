// The kernels for one vector width: included once a variant, whose name, lanes and target are defined.
#include "../simd.hpp"

#include "layers.hpp"
#include "half.hpp"
#include "networks.hpp"
#include "lookup.hpp"
#include "march.hpp"
#include "bent.hpp"
#include "tile.hpp"
#include "backward.hpp"
#include "entries.hpp"
