# Adapts the build to the ROS 2 wheels of PyPI. A package includes this file between find_package()
# and rosidl_generate_interfaces(); a package that is copied elsewhere builds without it.

# The wheels export targets with include folders of the machine where they were built, and CMake
# rejects a project that links such a target. Dropping missing folders changes nothing in a ROS
# installation, where CMake requires them to exist as well.
function(demandops_drop_missing_includes)
  get_property(targets DIRECTORY PROPERTY IMPORTED_TARGETS)
  foreach(target IN LISTS targets)
    get_target_property(folders ${target} INTERFACE_INCLUDE_DIRECTORIES)
    if(NOT folders)
      continue()
    endif()
    set(kept "")
    foreach(folder IN LISTS folders)
      if(folder MATCHES "\\$<" OR EXISTS "${folder}")
        list(APPEND kept "${folder}")
      endif()
    endforeach()
    set_property(TARGET ${target} PROPERTY INTERFACE_INCLUDE_DIRECTORIES "${kept}")
  endforeach()
endfunction()

# Deferred, because rosidl_generate_interfaces() imports these targets.
cmake_language(DEFER CALL demandops_drop_missing_includes)

# rclpy never loads the C++ support, which takes half of the build time. If ament renames its list
# of generators, this has no effect: the build is complete but slow.
option(DEMANDOPS_WITHOUT_CPP "Generate no C++ support for the interfaces" OFF)
if(DEMANDOPS_WITHOUT_CPP)
  list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "_cpp:")
endif()
