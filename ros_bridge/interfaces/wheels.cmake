# What building over the ROS 2 wheels of PyPI needs beyond a ROS installation. A package includes
# this between find_package() and rosidl_generate_interfaces(), and does without it where it stands
# alone.

# The wheels export targets that name include folders of the machine they were built on, and CMake
# generates nothing for a project that links such a target. Dropping the folders that do not exist
# changes nothing in a ROS installation, where CMake would insist on them too.
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

# The targets that matter are imported by rosidl_generate_interfaces(), so this waits for its end.
cmake_language(DEFER CALL demandops_drop_missing_includes)

# rclpy never loads the C++ support, which takes half of the build. Where ament keeps its list of
# generators under another name, this leaves it out of nothing and the build is complete, but slow.
option(DEMANDOPS_WITHOUT_CPP "Generate no C++ support for the interfaces" OFF)
if(DEMANDOPS_WITHOUT_CPP)
  list(FILTER AMENT_EXTENSIONS_rosidl_generate_idl_interfaces EXCLUDE REGEX "_cpp:")
endif()
