// The kernels for one vector width: included once a variant, whose name, lanes and target are defined.
#include "neumip_vector.hpp"

#include "neumip_layers.hpp"
#include "neumip_half.hpp"
#include "neumip_networks.hpp"
#include "neumip_lookup.hpp"
#include "neumip_march.hpp"
#include "neumip_tile.hpp"
#include "neumip_backward.hpp"
#include "neumip_entries.hpp"
