/* In skeleton_modifier3d.hpp. */
